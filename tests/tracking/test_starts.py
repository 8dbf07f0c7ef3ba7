"""Starts from features: poses from pairs of points, when these are asked for, wider searches."""

import dataclasses

import numpy as np
import pytest

from services.tracking.absolute_orientation import PointPairs, solve_points
from services.tracking.config import FeatureStartConfig, TrackingConfig, VerificationConfig
from services.tracking.estimate import attempt
from services.tracking.executors import NoHelper
from services.tracking.local_map import derive
from services.tracking.observed import EncodedImages, observe
from services.tracking.prediction import is_predictable
from services.tracking.stopwatch import Stopwatch
from shared.camera import Intrinsics
from shared.frames import Prior
from shared.se3 import Pose, angle_rad, exp, inverse, transform
from shared.tracks import Landmarks, TrackingContext

CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
TRUE_POSE = exp([0.4, -0.2, 0.9, 0.3, -1.0, 0.2])
SMALL_STEP = exp([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])
LARGE_STEP = exp([0.2, 0.0, 0.0, 0.0, 0.1, 0.0])


def pairs(count: int, wrong: int, depth_noise: float = 0.0) -> PointPairs:
    """Points 1 to 4 m ahead as a camera at TRUE_POSE measures them; the first ones are wrong."""
    rng = np.random.default_rng(5)
    pixels = rng.uniform([0, 0], [640, 480], (count, 2))
    depths = rng.uniform(1.0, 4.0, count)
    rays = np.column_stack([(pixels - [319.5, 239.5]) / 525.0, np.ones(count)])
    points_world = transform(TRUE_POSE, rays * depths[:, None])
    points_world[:wrong] = rng.uniform(-3.0, 3.0, (wrong, 3))
    measured = depths * (1.0 + depth_noise * depths * rng.standard_normal(count))
    return PointPairs(rays * measured[:, None], points_world, pixels)


def error(T) -> tuple[float, float]:
    step = inverse(TRUE_POSE) @ T
    return float(np.linalg.norm(step[:3, 3])), float(np.degrees(angle_rad(step)))


def test_exact_pairs_give_the_pose_though_most_are_wrong():
    T = solve_points(pairs(100, wrong=65), CAMERA, FeatureStartConfig())

    assert T is not None
    np.testing.assert_allclose(T, TRUE_POSE, atol=1e-9)


def test_depth_noise_of_a_kinect_leaves_a_start_within_centimetres():
    T = solve_points(pairs(100, wrong=40, depth_noise=0.003), CAMERA, FeatureStartConfig())

    metres, degrees = error(T)
    assert metres < 0.03
    assert degrees < 0.8


@pytest.mark.parametrize(("count", "wrong"), [(0, 0), (14, 0), (60, 50), (60, 60)])
def test_too_few_pairs_that_agree_are_no_pose(count, wrong):
    assert solve_points(pairs(count, wrong), CAMERA, FeatureStartConfig()) is None


def test_points_on_a_line_are_no_pose():
    line = pairs(40, wrong=0)
    same_row = line.points_camera * [1.0, 0.0, 0.0] + [0.0, 0.0, 2.0]
    pixels = np.column_stack([525.0 * same_row[:, 0] / 2.0 + 319.5, np.full(40, 239.5)])

    T = solve_points(PointPairs(same_row, same_row, pixels), CAMERA, FeatureStartConfig())

    assert T is None


def test_the_same_pairs_give_the_same_bits():
    noisy = pairs(80, wrong=40, depth_noise=0.003)

    first, second = (solve_points(noisy, CAMERA, FeatureStartConfig()) for _ in range(2))

    assert first is not None and second is not None
    assert first.tobytes() == second.tobytes()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, True),
        ({"T_before_last": LARGE_STEP}, False),
        ({"lost_frames": 1}, False),
        ({"before_last_dt_ns": 0}, False),
        ({"t_ns": 200}, False),
        ({"T_before_last": exp([0.03, 0.0, 0.0, 0.0, 0.0, 0.0]), "t_ns": 600}, False),
    ],
    ids=["small", "large", "lost", "no motion yet", "long ago", "small, two frames ago"],
)
def test_after_a_recent_small_step_a_frame_is_predictable(room, change, expected):
    before = dataclasses.replace(Prior(7, 700, np.eye(4), SMALL_STEP, 100, 3, 3, 0, 2), **change)
    frame = dataclasses.replace(room.frame(8, np.eye(4)), t_ns=800)

    assert is_predictable(before, frame, VerificationConfig()) == expected


def test_odometry_of_its_own_makes_large_steps_predictable(room):
    odom = Pose.from_matrix(np.eye(4))
    before = Prior(7, 700, np.eye(4), LARGE_STEP, 100, 3, 3, 0, 2, T_odom_camera=odom)
    frame = dataclasses.replace(room.frame(8, np.eye(4)), t_ns=800, T_odom_camera=odom)

    assert is_predictable(before, frame, VerificationConfig())


def test_few_landmarks_26_pixels_off_draw_the_pose_along_a_wall(room, session):
    session.track(room.frame(0, np.eye(4)))
    config = TrackingConfig()
    few = derive(with_landmarks(session.store.context(0), 30), config.registration)
    frame = room.frame(1, np.eye(4))
    images = EncodedImages(frame.rgb, frame.depth, room.calibration)
    observed = observe(images, config, Stopwatch(), NoHelper())

    found = attempt(observed, few, exp([0.21, 0.0, 0.0, 0.0, 0.0, 0.0]), config, Stopwatch())

    assert np.linalg.norm(found.T_world_camera[:3, 3]) < 0.003
    assert found.inliers >= 25


def with_landmarks(context: TrackingContext, count: int) -> TrackingContext:
    """A context that knows only so many landmarks, from all over the image."""
    all_of_them = context.landmarks
    rows = np.linspace(0, len(all_of_them.ids) - 1, count).astype(np.int64)
    names = [field.name for field in dataclasses.fields(all_of_them)]
    some = Landmarks(**{name: getattr(all_of_them, name)[rows] for name in names})
    return dataclasses.replace(context, landmarks=some)
