"""Gaussians without networks: the paper's ablation as a map of its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from services.mapping.anchors.anchor_map import AnchorMap, NewAnchors
from services.mapping.config import AnchorConfig, MappingConfig
from services.mapping.decoding.decoders import NeuralDecoder, PlainDecoder, decoder_for
from shared.errors import ConfigError

PLAIN = AnchorConfig(gaussians="plain")
CPU = torch.device("cpu")
CAMERA = torch.tensor([0.0, 0.0, -2.0])


@pytest.fixture
def anchors() -> AnchorMap:
    rng = np.random.default_rng(0)
    count = 6
    anchors = AnchorMap(PLAIN, CPU)
    new = NewAnchors(
        positions=rng.normal(0, 1, (count, 3)).astype(np.float32),
        features=rng.normal(0, 1, (count, 32)).astype(np.float32),
        offsets=rng.normal(0, 1, (count, 15)).astype(np.float32),
        scalings=rng.normal(-4, 0.3, (count, 6)).astype(np.float32),
        keys=np.arange(count),
        is_primary=np.zeros(count, bool),
    )
    anchors.append(new, creator_seq=0)
    return anchors


def test_the_setting_names_the_decoder():
    plain = decoder_for(MappingConfig(anchors=PLAIN), 0, CPU)
    neural = decoder_for(MappingConfig(), 0, CPU)

    assert isinstance(plain, PlainDecoder)
    assert isinstance(neural, NeuralDecoder)


def test_plain_gaussians_start_where_and_as_neural_ones_do(anchors):
    rows = anchors.rows
    neural = AnchorMap(AnchorConfig(), CPU)
    neural.rows.append(
        {
            "position": rows["position"],
            "features": torch.nn.functional.pad(rows["colours"], (0, 17)),
            "offsets": rows["offsets"],
            "scalings": rows["scalings"],
        }
    )
    index = torch.arange(6)
    decoder = NeuralDecoder(MappingConfig(), 0, CPU)

    _, expected = decoder.decode(neural, index, CAMERA)
    _, found = PlainDecoder(PLAIN.initial_opacity).decode(anchors, index, CAMERA)

    torch.testing.assert_close(found.means, expected.means)
    torch.testing.assert_close(found.scales, expected.scales, rtol=0.1, atol=0)
    torch.testing.assert_close(found.opacities, expected.opacities, rtol=0, atol=0.05)
    torch.testing.assert_close(found.colours, expected.colours, rtol=0, atol=0.05)


def test_plain_gaussians_do_not_depend_on_the_view(anchors):
    index, decoder = torch.arange(6), PlainDecoder(0.6)

    _, here = decoder.decode(anchors, index, CAMERA)
    _, there = decoder.decode(anchors, index, 3.0 * CAMERA)

    for a, b in zip(here.tensors(), there.tensors(), strict=True):
        assert torch.equal(a, b)


def test_every_plain_parameter_gets_a_gradient(anchors):
    visible, gaussians = PlainDecoder(0.6).decode(anchors, torch.arange(6), CAMERA, True)

    torch.cat([tensor.flatten() ** 2 for tensor in gaussians.tensors()]).sum().backward()

    for name in ("colours", "offsets", "opacities", "sizes", "turns"):
        assert getattr(visible, name).grad.abs().sum() > 0


def test_what_grows_from_a_plain_anchor_has_its_colours_and_size(anchors):
    anchors.rows["sizes"][2] = 0.7

    features, sizes = (
        anchors.heirs_features(torch.tensor([2])),
        anchors.log_sizes(torch.tensor([2])),
    )

    assert torch.equal(features[0, :15], anchors.rows["colours"][2])
    torch.testing.assert_close(sizes[0], anchors.rows["scalings"][2, 3:] + 0.7)


def test_plain_gaussians_have_no_features_to_embed():
    with pytest.raises(ConfigError, match="plain"):
        AnchorConfig(gaussians="plain", features="environment")
