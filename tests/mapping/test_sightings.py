"""How well a map knows a view, of a wall 2 m away that keyframes at known places saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from services.mapping.rasterizer import View
from services.mapping.views.sightings import MAX_KEYFRAMES, Sightings
from services.mapping.views.training_views import TrainingView
from shared import se3
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import DepthEncoding, Frame
from shared.images import encode_depth, encode_jpeg
from shared.rectify import RgbdImage

CAMERA = Intrinsics(320.0, 320.0, 159.5, 119.5, 320, 240)
CALIBRATION = Calibration(Camera(CAMERA), depth_scale=1000.0)
WALL_M = 2.0


@dataclass(frozen=True)
class Drawn:
    depth_m: np.ndarray
    alpha: np.ndarray


def at(x: float = 0.0, z: float = 0.0) -> np.ndarray:
    return se3.exp([x, 0.0, z, 0.0, 0.0, 0.0])


def wall(z: float = 0.0) -> np.ndarray:
    """Depth of the wall from a camera that faces it."""
    return np.full((240, 320), WALL_M - z, np.float32)


def keyframe(seq: int, T_world_camera: np.ndarray, depth_m: np.ndarray) -> TrainingView:
    raw = (1000 * depth_m).astype(np.uint16)
    rgb = encode_jpeg(np.zeros((240, 320, 3), np.uint8))
    frame = Frame(seq, seq, rgb, encode_depth(raw, DepthEncoding.RAW16))
    return TrainingView(seq, seq, frame, T_world_camera)


@pytest.fixture
def confidence():
    """Mean confidence, 0 to 1, of a view of the wall after keyframes at places."""

    def mean(T: np.ndarray, z: float, keyframes: list[TrainingView], alpha: int = 255) -> float:
        view = View(se3.inverse(T), CAMERA)
        drawn = Drawn(wall(z) if alpha else 0 * wall(), np.full((240, 320), alpha, np.uint8))
        return float(Sightings(CALIBRATION).confidence(drawn, view, keyframes).mean()) / 255.0

    return mean


def test_a_keyframes_own_view_is_fully_known(confidence):
    assert confidence(at(), 0.0, [keyframe(0, at(), wall())]) > 0.97


def test_a_view_of_nothing_is_not_known(confidence):
    assert confidence(at(), 0.0, [keyframe(0, at(), wall())], alpha=0) == 0.0
    assert confidence(at(), 0.0, []) == 0.0


def test_a_side_that_no_keyframe_faced_is_not_known(confidence):
    behind = se3.exp([0, 0, 0, 0, np.pi, 0])

    assert confidence(behind, 0.0, [keyframe(0, at(), wall())]) == 0.0


def test_the_further_aside_the_less_is_known(confidence):
    aside = [confidence(at(x), 0.0, [keyframe(0, at(), wall())]) for x in (0.0, 0.3, 0.6, 1.2)]

    assert aside == sorted(aside, reverse=True)
    assert aside[0] > aside[1] + 0.1 > aside[3] + 0.3


def test_nearer_than_any_keyframe_shows_detail_that_none_had(confidence):
    near = confidence(at(z=1.0), 1.0, [keyframe(0, at(), wall())])

    assert near == pytest.approx(0.5, abs=0.05)


def test_what_a_keyframe_saw_hidden_behind_something_is_not_known(confidence):
    hidden = [keyframe(0, at(), wall() - 1.0)]

    assert confidence(at(), 0.0, hidden) < 0.01


def test_depth_that_a_keyframe_lacks_halves_what_it_knows(confidence):
    assert confidence(at(), 0.0, [keyframe(0, at(), 0 * wall())]) == pytest.approx(0.5, abs=0.02)


def test_thin_gaussians_are_known_less(confidence):
    keyframes = [keyframe(0, at(), wall())]

    assert confidence(at(), 0.0, keyframes, alpha=128) == pytest.approx(0.25, abs=0.02)


def test_the_best_keyframe_is_found_among_many(confidence):
    others = [keyframe(seq, at(3.0), wall()) for seq in range(2 * MAX_KEYFRAMES)]
    best = keyframe(100, at(), wall())

    assert confidence(at(), 0.0, [*others, best]) > 0.97


def test_depth_is_the_same_whether_kept_or_decoded_after_a_restart():
    kept, restarted = Sightings(CALIBRATION), Sightings(CALIBRATION)
    keyframes = [keyframe(0, at(0.2), wall())]
    kept.add(0, RgbdImage(np.zeros((240, 320, 3), np.uint8), wall(), CAMERA))
    drawn, view = Drawn(wall(), np.full((240, 320), 255, np.uint8)), View(np.eye(4), CAMERA)

    found = [sightings.confidence(drawn, view, keyframes) for sightings in (kept, restarted)]

    assert np.array_equal(found[0], found[1])
