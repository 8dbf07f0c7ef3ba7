"""What a new keyframe changes at once: its own exposure, and the colours of young anchors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from services.mapping.config import AnchorConfig, MappingConfig
from services.mapping.pipeline import Mapper, NewKeyframe
from services.mapping.views.appearance import IDENTITY
from shared.images import encode_jpeg
from shared.maps import RenderRequest
from shared.tracks import KeyframePoses


@pytest.fixture
def make_mapper(calibration, insert):
    """A map of one keyframe that had so many iterations."""

    def make(iterations: int, **anchors) -> Mapper:
        config = MappingConfig(anchors=AnchorConfig(**anchors))
        mapper = Mapper(calibration, config, 0, torch.device("cpu"))
        insert(mapper, 0)
        mapper.iterate(iterations)
        return mapper

    return make


@pytest.fixture
def insert(frame, true_colour, true_pose):
    """Inserts a keyframe at its true pose, its colours seen through a gain and a bias."""

    def run(mapper: Mapper, seq: int, gain: float = 1.0, bias: float = 0.0) -> None:
        seqs = [*mapper.views.seqs(), seq]
        poses = KeyframePoses(len(seqs), np.array(seqs), np.stack([true_pose(s) for s in seqs]))
        seen = (true_colour(seq) * gain + 255.0 * bias).clip(0, 255).round().astype(np.uint8)
        exposed = replace(frame(seq), rgb=encode_jpeg(seen, 98))
        mapper.insert_keyframe(NewKeyframe(exposed, poses, np.zeros((0, 3))))

    return run


@pytest.fixture
def psnr_db(calibration, true_pose, true_colour):
    """PSNR of the map's own colours, from a frame's pose, against the exact ones."""

    def score(mapper: Mapper, seq: int) -> float:
        view = mapper.render(RenderRequest(true_pose(seq), calibration.colour.intrinsics, 0))
        error = view.rgb / 255.0 - true_colour(seq) / 255.0
        return float(-10 * np.log10(np.mean(error**2)))

    return score


def spoil(mapper: Mapper, column: str = "features") -> None:
    """Another wrong colour for each anchor, right in the mean."""
    values = mapper.anchors.rows[column]
    noise = torch.randn(len(values), 1, generator=torch.Generator().manual_seed(0))
    values[:, :15] += noise


@pytest.mark.parametrize("gain", [0.6, 1.3])
def test_a_keyframe_starts_with_the_gain_that_the_map_tells(make_mapper, insert, gain):
    mapper = make_mapper(40)

    insert(mapper, 4, gain=gain)

    # Six seeds were off by 0.046 to 0.065.
    np.testing.assert_allclose(mapper.exposures.of(4)[0], gain, atol=0.07)


def test_under_a_fixed_exposure_nothing_is_fitted(make_mapper, insert):
    mapper = make_mapper(40)

    insert(mapper, 4)

    np.testing.assert_array_equal(mapper.exposures.of(4), IDENTITY)


def test_what_a_dark_keyframe_adds_has_the_colours_of_the_map(make_mapper, insert, psnr_db):
    mapper = make_mapper(40)

    insert(mapper, 12, gain=0.6)  # a fifth of it was not seen before

    assert psnr_db(mapper, 12) > 24.0


def test_a_keyframe_without_overlap_takes_the_exposure_before_it(make_mapper, insert):
    mapper = make_mapper(40)
    insert(mapper, 4, gain=0.6)

    insert(mapper, 300, gain=1.2)

    np.testing.assert_array_equal(mapper.exposures.of(300), mapper.exposures.of(4))


def test_a_young_map_takes_over_what_a_keyframe_sees(make_mapper, insert, psnr_db):
    mapper = make_mapper(0)
    spoil(mapper)
    before = psnr_db(mapper, 4)

    insert(mapper, 4)

    assert psnr_db(mapper, 4) > before + 1.5


def test_without_fusion_steps_no_colour_is_taken_over(make_mapper, insert):
    mapper = make_mapper(0, fusion_steps=0.0)
    spoil(mapper)
    before, count = mapper.anchors.rows["features"].clone(), len(mapper.anchors)

    insert(mapper, 4)

    torch.testing.assert_close(mapper.anchors.rows["features"][:count], before)


def test_anchors_that_have_learned_for_long_hardly_move(make_mapper, insert):
    young, old = make_mapper(0), make_mapper(0)
    old.anchors.rows["steps"].fill_(500)
    moved = []
    for mapper in (young, old):
        spoil(mapper)
        before, count = mapper.anchors.rows["features"].clone(), len(mapper.anchors)
        insert(mapper, 4)
        moved.append((mapper.anchors.rows["features"][:count] - before).abs().mean().item())

    assert moved[1] < 0.02 * moved[0]


def test_a_plain_map_takes_over_colours_too(make_mapper, insert, psnr_db):
    mapper = make_mapper(0, gaussians="plain")
    spoil(mapper, "colours")
    before = psnr_db(mapper, 4)

    insert(mapper, 4)

    assert psnr_db(mapper, 4) > before + 1.5


def test_a_black_keyframe_takes_no_colour_away(make_mapper, insert):
    mapper = make_mapper(0)
    before, count = mapper.anchors.rows["features"].clone(), len(mapper.anchors)

    insert(mapper, 4, gain=0.0)

    torch.testing.assert_close(mapper.anchors.rows["features"][:count], before)
