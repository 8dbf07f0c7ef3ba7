"""Keyframes that lie on the map as their colours want it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from services.mapping.config import LearningRates, MappingConfig, RefinementConfig
from services.mapping.pipeline import Mapper, NewKeyframe
from services.mapping.views.alignment import Pair, twist_of
from services.mapping.views.pose_offsets import PoseOffsets
from shared import se3
from shared.camera import Intrinsics
from shared.tracks import KeyframePoses

CAMERA = Intrinsics(fx=80.0, fy=80.0, cx=79.5, cy=59.5, width=160, height=120)
TWIST = np.array([0.006, -0.004, 0.01, 0.002, -0.003, 0.004])


def grey(T_camera_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A waving wall at z = 2: brightness and depth, [H, W], exact."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)])
    T = se3.inverse(T_camera_world)
    directions = np.einsum("ij,jvu->ivu", T[:3, :3], rays)
    depth = (2.0 - T[2, 3]) / directions[2]
    x, y = T[:2, 3, None, None] + directions[:2] * depth
    brightness = 0.5 + 0.2 * np.sin(7 * x + 2 * y) + 0.2 * np.cos(3 * x - 8 * y)
    return brightness.astype(np.float32), depth.astype(np.float32)


def test_a_few_steps_bring_a_camera_to_where_its_image_was_taken():
    seen, _ = grey(se3.exp(TWIST))
    T = np.eye(4)

    for _ in range(5):
        drawn, depth_m = grey(T)
        T = se3.exp(twist_of(Pair(drawn, seen, depth_m), CAMERA)) @ T

    assert se3.log(T) == pytest.approx(TWIST, abs=2e-5)


def test_an_object_in_the_way_hardly_moves_the_camera():
    seen, _ = grey(se3.exp(TWIST))
    seen[20:60, 30:80] = 1.0
    T = np.eye(4)

    for _ in range(8):
        drawn, depth_m = grey(T)
        T = se3.exp(twist_of(Pair(drawn, seen, depth_m), CAMERA)) @ T

    assert np.linalg.norm(se3.log(T)[:3] - TWIST[:3]) < 1e-3


@pytest.mark.parametrize("nothing", ["texture", "depth"])
def test_without_texture_or_depth_nothing_moves(nothing):
    drawn, depth_m = grey(np.eye(4))
    blank = np.full_like(drawn, 0.5)
    pairs = {"texture": Pair(blank, blank + 0.1, depth_m), "depth": Pair(drawn, blank, 0 * depth_m)}

    assert twist_of(pairs[nothing], CAMERA).tolist() == [0.0] * 6


def test_images_too_far_apart_tell_nothing():
    seen, _ = grey(se3.exp([0.5, 0.3, 0.2, 0, 0, 0.5]))
    drawn, depth_m = grey(np.eye(4))
    steep = Pair(drawn * 0.01, seen, depth_m)

    assert np.linalg.norm(twist_of(steep, CAMERA)[:3]) < 0.05


def test_an_offset_settles_at_three_quarters_of_what_the_image_asks_for():
    offsets, asked = PoseOffsets(), np.array([0.004, 0, 0, 0, 0, 0])

    for _ in range(60):
        missing = asked + se3.log(offsets.of(3))  # of T_camera_world: the offset's inverse
        offsets.move(3, missing, rate=0.3)

    assert se3.log(offsets.of(3))[0] == pytest.approx(-0.003, abs=2e-4)


@pytest.fixture
def misplaced(calibration, frame, true_pose) -> Callable[[float], Mapper]:
    """A map of five keyframes whose third is told 8 mm aside, refined with a rate of poses."""

    def build(rate: float) -> Mapper:
        rates = LearningRates(poses=rate)
        config = MappingConfig(refinement=RefinementConfig(rates=rates))
        mapper = Mapper(calibration, config, 0, torch.device("cpu"))
        seqs = [0, 2, 4, 6, 8]
        poses = np.stack([true_pose(seq) for seq in seqs])
        poses[2, 1, 3] += 0.008
        for count, seq in enumerate(seqs, start=1):
            told = KeyframePoses(count, np.array(seqs[:count]), poses[:count])
            mapper.insert_keyframe(NewKeyframe(frame(seq), told, np.zeros((0, 3))))
            mapper.iterate(8)
        for done in range(60):
            mapper.refine(done / 60)
        return mapper

    return build


def _is_off_by_m(mapper: Mapper, seq: int, true_pose) -> float:
    return float(abs(mapper.views[seq].T_world_camera - true_pose(seq))[:3, 3].max())


def test_a_refinement_brings_a_misplaced_keyframe_back(misplaced, true_pose):
    assert _is_off_by_m(misplaced(0.3), 4, true_pose) < 0.005


def test_without_a_rate_keyframes_stay_where_tracking_has_them(misplaced, true_pose):
    mapper = misplaced(0.0)

    assert _is_off_by_m(mapper, 4, true_pose) == pytest.approx(0.008, abs=1e-6)
    assert mapper.views.offsets.all() == {}


def test_the_first_keyframe_says_where_the_map_is(misplaced, true_pose):
    mapper = misplaced(0.3)

    assert _is_off_by_m(mapper, 0, true_pose) == 0.0
    assert 0 not in mapper.views.offsets.all()


def test_an_offset_stays_when_tracking_corrects_its_keyframe(misplaced, true_pose):
    mapper = misplaced(0.3)
    T_new = se3.from_rotation(np.eye(3), [1.0, 0.0, 0.0]) @ true_pose(4)

    mapper.views.set_pose(4, T_new)

    expected = T_new @ mapper.views.offsets.of(4)
    np.testing.assert_array_equal(mapper.views[4].T_world_camera, expected)


def test_a_map_that_is_taken_up_has_its_offsets(misplaced, calibration, frame):
    mapper = misplaced(0.3)
    taken_up = Mapper(calibration, MappingConfig(), 0, torch.device("cpu"))

    taken_up.restore(mapper.state(), {seq: frame(seq) for seq in mapper.views.seqs()}, {})

    for seq, T in mapper.views.offsets.all().items():
        np.testing.assert_array_equal(taken_up.views.offsets.of(seq), T)
        np.testing.assert_array_equal(
            taken_up.views[seq].T_world_camera, mapper.views[seq].T_world_camera
        )
