"""The networks: the CPU twin against plain autograd, and what they give at the start."""

from __future__ import annotations

import pytest
import torch

from services.mapping.config import AnchorConfig, DecoderConfig
from services.mapping.decoding.cpu import decode_cpu
from services.mapping.decoding.decoder import WEIGHTS, VisibleAnchors, decode, initial_weights

CAMERA = torch.tensor([0.3, -0.2, -1.0])


def anchors(count: int = 5000) -> VisibleAnchors:
    generator = torch.Generator().manual_seed(1)

    def normal(width: int, sigma: float) -> torch.Tensor:
        return (torch.randn(count, width, generator=generator) * sigma).requires_grad_()

    positions = torch.randn(count, 3, generator=generator)
    turns = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
    scalings = (torch.randn(count, 6, generator=generator) * 0.3 - 4.0).requires_grad_()
    return VisibleAnchors(
        torch.arange(count), positions, turns, normal(32, 1.0), normal(15, 1.0), scalings
    )


def rough_weights() -> dict[str, torch.Tensor]:
    """Weights far from the start, so that every path carries a gradient."""
    generator = torch.Generator().manual_seed(2)
    weights = initial_weights(AnchorConfig(), DecoderConfig(), 0)
    return {
        name: (w + 0.3 * torch.randn(w.shape, generator=generator)).requires_grad_()
        for name, w in weights.items()
    }


def test_the_cpu_decoder_equals_the_plain_one():
    visible, weights = anchors(), rough_weights()

    plain, fast = decode(visible, CAMERA, weights), decode_cpu(visible, CAMERA, weights)

    for expected, found in zip(plain.tensors(), fast.tensors(), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_the_cpu_decoders_gradients_equal_the_plain_ones():
    gradients = []
    for function in (decode, decode_cpu):
        visible, weights = anchors(), rough_weights()
        tensors = function(visible, CAMERA, weights).tensors()
        generator = torch.Generator().manual_seed(3)
        random = [torch.randn(t.shape, generator=generator) for t in tensors]
        torch.autograd.backward(list(tensors), random)
        leaves = [visible.features, visible.offsets, visible.scalings]
        gradients.append([leaf.grad for leaf in [*leaves, *(weights[w] for w in WEIGHTS)]])

    for expected, found in zip(*gradients, strict=True):
        assert (found - expected).norm() < 1e-4 * expected.norm()


def test_anchors_start_with_the_initial_opacity_and_the_colours_of_their_features():
    visible = anchors(100)
    weights = initial_weights(AnchorConfig(), DecoderConfig(), 0)

    gaussians = decode(visible, CAMERA, weights)

    torch.testing.assert_close(gaussians.opacities.mean().item(), 0.6, atol=0.02, rtol=0)
    features = visible.features[:, :15].reshape(-1, 3)
    torch.testing.assert_close(gaussians.colours, features.sigmoid(), atol=0.05, rtol=0)


def test_children_sit_at_the_anchor_plus_their_scaled_offsets():
    visible = anchors(7)

    means = decode(visible, CAMERA, rough_weights()).means.view(7, 5, 3)

    scaled = visible.offsets.view(7, 5, 3) * visible.scalings[:, None, :3].exp()
    torch.testing.assert_close(means, visible.positions[:, None] + scaled)


def test_a_child_with_negative_opacity_is_not_drawn():
    weights = initial_weights(AnchorConfig(), DecoderConfig(), 0)
    weights["opacity_bias"][2] = -1.0

    opacities = decode(anchors(10), CAMERA, weights).opacities.view(10, 5)

    assert (opacities[:, 2] == 0).all()
    assert (opacities[:, :2] > 0).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_weights_depend_on_the_seed_alone(seed):
    a, b = (initial_weights(AnchorConfig(), DecoderConfig(), seed) for _ in range(2))

    assert all(torch.equal(a[name], b[name]) for name in WEIGHTS)
