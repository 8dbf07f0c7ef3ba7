"""Prediction, verification, and the rules of keyframes."""

import dataclasses

import numpy as np
import pytest

from services.tracking.config import (
    KeyframeRuleConfig,
    OrbConfig,
    RegistrationConfig,
    SurfaceConfig,
    TrackingConfig,
    VerificationConfig,
)
from services.tracking.keyframes import (
    Coverage,
    becomes_keyframe,
    nearest_reference,
    thinned,
    thumbnail_of,
)
from services.tracking.point_cloud import surface_from_depth
from services.tracking.prediction import predict, turned_starts
from services.tracking.twists import exp_twist, inverse_rigid, log_twist
from services.tracking.verification import depth_agreement, is_possible_step
from shared.config import override
from shared.errors import ConfigError
from shared.frames import Prior
from shared.se3 import Pose, angle_rad, exp, inverse, log
from shared.tracks import PointCloud

STEP = exp([0.02, 0.0, 0.01, 0.0, 0.02, 0.0])
WELL_COVERED = Coverage(9000, 0.95, 300, 0.8, exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]), 2.0, 1.0)


def prior(**changes) -> Prior:
    T = exp([1.0, 0.5, -0.2, 0.3, 0.1, 0.2])
    values = Prior(7, 700, T, STEP, 100, 3, 3, 0, 2)
    return dataclasses.replace(values, **changes)


def frame_at(room, t_ns: int, **changes):
    return dataclasses.replace(room.frame(8, np.eye(4)), t_ns=t_ns, **changes)


def test_a_steady_camera_is_expected_one_step_further(room):
    before = prior()

    expected = predict(before, frame_at(room, 800))

    np.testing.assert_allclose(expected, before.T_world_camera @ STEP, atol=1e-9)


def test_a_gap_of_two_frames_is_two_steps(room):
    before = prior()

    expected = predict(before, frame_at(room, 900))

    np.testing.assert_allclose(expected, before.T_world_camera @ STEP @ STEP, atol=1e-9)


@pytest.mark.parametrize("change", [{"lost_frames": 1}, {"before_last_dt_ns": 0}])
def test_without_a_recent_motion_the_camera_is_expected_to_stand(room, change):
    before = prior(**change)

    np.testing.assert_array_equal(predict(before, frame_at(room, 800)), before.T_world_camera)


def test_the_cameras_own_odometry_goes_before_constant_velocity(room):
    odom = exp([5.0, 2.0, 0.0, 0.0, 0.0, 1.0])
    moved = exp([0.0, 0.0, 0.3, 0.0, 0.1, 0.0])
    before = prior(T_odom_camera=Pose.from_matrix(odom))

    expected = predict(before, frame_at(room, 800, T_odom_camera=Pose.from_matrix(odom @ moved)))

    np.testing.assert_allclose(expected, before.T_world_camera @ moved, atol=1e-9)


def test_turned_starts_stand_where_the_prediction_does_and_look_six_other_ways():
    predicted = exp([1.0, 0.5, -0.2, 0.3, 0.1, 0.2])

    starts = turned_starts(predicted, 10.0)

    turns = [inverse(predicted) @ start for start in starts]
    np.testing.assert_allclose([turn[:3, 3] for turn in turns], 0.0, atol=1e-12)
    np.testing.assert_allclose([np.degrees(angle_rad(turn)) for turn in turns], 10.0)
    assert len({tuple(np.round(log(turn), 6)) for turn in turns}) == 6


def test_a_well_covered_frame_is_no_keyframe(room):
    frame = frame_at(room, 800)

    assert not becomes_keyframe(frame, prior(), WELL_COVERED, KeyframeRuleConfig())


@pytest.mark.parametrize(
    "change",
    [
        {"overlap": 0.6},
        {"landmark_share": 0.1},
        {"landmarks": 80, "waiting": 100},
        {"num_points": 0, "landmark_share": 0.1},
        {"T_reference_camera": exp([0.1, 0.0, 0.0, 0.0, 0.4, 0.0])},
        {"T_reference_camera": exp([0.6, 0.0, 0.0, 0.0, 0.0, 0.0])},
    ],
)
def test_a_frame_that_shows_something_new_is_one(room, change):
    coverage = dataclasses.replace(WELL_COVERED, **change)

    assert becomes_keyframe(frame_at(room, 800), prior(), coverage, KeyframeRuleConfig())


@pytest.mark.parametrize(
    "change",
    [
        {"landmarks": 80, "waiting": 70},
        {"landmarks": 130, "waiting": 800},
        {"num_points": 0, "overlap": 0.0},  # no surface is nothing new
        {"num_points": 400, "overlap": 0.1, "landmarks": 40, "landmark_share": 0.1},
    ],
)
def test_a_frame_that_brings_little_or_is_held_by_little_is_none(room, change):
    coverage = dataclasses.replace(WELL_COVERED, **change)

    assert not becomes_keyframe(frame_at(room, 800), prior(), coverage, KeyframeRuleConfig())


def test_the_tenth_frame_since_the_last_keyframe_is_one(room):
    before = prior(frames_since_keyframe=9)

    assert becomes_keyframe(frame_at(room, 800), before, WELL_COVERED, KeyframeRuleConfig())


def test_a_frame_kept_from_the_map_never_is(room):
    coverage = dataclasses.replace(WELL_COVERED, overlap=0.1)
    frame = frame_at(room, 800, may_be_keyframe=False)

    assert not becomes_keyframe(frame, prior(), coverage, KeyframeRuleConfig())


def test_a_standing_camera_adds_no_keyframes(room):
    coverage = dataclasses.replace(WELL_COVERED, T_reference_camera=np.eye(4))
    before = prior(frames_since_keyframe=1000)

    assert not becomes_keyframe(frame_at(room, 800), before, coverage, KeyframeRuleConfig())


def test_the_reference_changes_only_for_a_much_nearer_keyframe():
    here = exp([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    keyframes = [(i, exp([x, 0.0, 0.0, 0.0, 0.0, 0.0])) for i, x in enumerate((0.5, 0.6, 0.9))]

    assert nearest_reference(here, keyframes[0], keyframes[:2], 1.0)[0] == 0
    assert nearest_reference(here, keyframes[0], keyframes, 1.0)[0] == 2


def test_a_cloud_is_thinned_evenly_to_the_limit():
    points = np.arange(3000, dtype=np.float32).reshape(-1, 3)

    thin = thinned(PointCloud(points, points), 100)

    assert len(thin.points) == 100
    assert thin.points[0, 0] == 0.0 and thin.points[-1, 0] == points[-1, 0]


def test_a_thumbnail_is_20_by_15_grey(room):
    thumbnail = thumbnail_of(room.view(np.eye(4)).rgb)

    assert thumbnail.shape == (15, 20) and thumbnail.dtype == np.uint8


def agreement(room, T_true, T_said):
    image = room.view(T_true)
    seen = room.view(np.eye(4))
    cloud = surface_from_depth(seen.depth_m, seen.intrinsics, SurfaceConfig())
    return depth_agreement(image, cloud, T_said, VerificationConfig())


def test_depth_agrees_at_the_true_pose(room):
    T = exp([0.2, 0.0, -0.1, 0.0, 0.2, 0.0])

    assert agreement(room, T, T).share > 0.99


def test_depth_refutes_a_wrong_pose(room):
    assert agreement(room, np.eye(4), exp([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])).share < 0.5


def test_a_step_is_possible_only_in_enough_frames():
    start, end = np.eye(4), exp([1.5, 0.0, 0.0, 0.0, 0.0, 0.0])

    assert not is_possible_step(start, end, 1, VerificationConfig())
    assert is_possible_step(start, end, 2, VerificationConfig())


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 0.1, 1.0])
def test_compiled_twists_equal_those_of_shared(scale):
    twist = scale * np.array([0.3, -1.2, 0.7, 0.9, -1.1, 0.5])

    np.testing.assert_allclose(exp_twist(twist), exp(twist), atol=1e-12)
    np.testing.assert_allclose(log_twist(exp(twist)), log(exp(twist)), atol=1e-9)
    np.testing.assert_allclose(inverse_rigid(exp(twist)), inverse(exp(twist)), atol=1e-12)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("surface", {"stride_px": 0}),
        ("surface", {"max_depth_m": 0.1}),
        ("registration", {"sample_steps": [1, 2]}),
        ("registration", {"voxel_sizes_m": [0.2, 0.1, 0.07]}),
        ("orb", {"num_features": -1}),
        ("keyframe", {"max_interval": 0}),
        ("surface", {"strides": 4}),
    ],
)
def test_settings_out_of_range_or_unknown_are_refused(key, value):
    with pytest.raises(ConfigError):
        override(TrackingConfig(), {key: value})


def test_the_defaults_are_in_range():
    assert RegistrationConfig().voxel_sizes_m[-1] < RegistrationConfig().voxel_sizes_m[0]
    assert OrbConfig().num_features <= OrbConfig().num_detected
