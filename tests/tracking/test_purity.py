"""The answer is a function of the request and the map: no worker, cache or odometry changes it."""

import dataclasses

import numpy as np
import pytest

from benchmarks.tracking_run import StoreSource as CachingSource
from services.tracking.config import TrackingConfig
from services.tracking.pipeline import track
from shared import codec
from shared.frames import HAS_POSE, Frame, TrackingStatus
from shared.se3 import Pose, angle_rad, exp, inverse
from shared.tracks import TrackResult

STEP = np.array([0.02, -0.005, 0.015, 0.004, 0.012, -0.003])
ERROR_1_M = exp([0.6, -0.5, 0.6, 0.0, 0.0, 0.0])


def path(index: int) -> np.ndarray:
    return exp(index * STEP)


def untimed(result: TrackResult) -> bytes:
    return codec.pack(dataclasses.replace(result, timings_ms={}))


def test_a_worker_that_keeps_its_map_answers_a_walk_with_the_bytes_of_new_ones(room, session):
    warm = CachingSource(session.store, session.config)
    pairs = []

    for i in range(24):
        frame = room.frame(i, path(i))
        kept = track(session.request(frame), warm, TrackingConfig())
        pairs.append((untimed(kept), untimed(session.track(frame))))

    assert len(session.store) >= 3
    assert [n for n, (kept, new) in enumerate(pairs) if kept != new] == []


def test_a_relocalisation_is_repeated_to_the_byte(room, session):
    for i in range(6):
        session.track(room.frame(i, path(i)))
    away = exp([0.2, 0.0, -0.3, 0.0, 1.6, 0.0])
    session.prior = dataclasses.replace(session.prior, T_world_camera=away, lost_frames=5)
    frame = room.frame(6, path(3))

    first, second = session.answer(frame), session.answer(frame)

    assert first.status in HAS_POSE
    assert untimed(first) == untimed(second)


def with_odometry(frame: Frame, T_odom_camera: np.ndarray) -> Frame:
    return dataclasses.replace(frame, T_odom_camera=Pose.from_matrix(T_odom_camera))


@pytest.mark.parametrize("wrong_from", [3, 8])
def test_odometry_that_is_a_metre_off_in_every_frame_does_not_break_tracking(
    room, session, wrong_from
):
    T_odom = exp([3.0, 1.0, 0.0, 0.0, 0.5, 0.0])
    results = []

    for i in range(12):
        T_odom = T_odom @ exp(STEP) @ (ERROR_1_M if i >= wrong_from else np.eye(4))
        results.append(session.track(with_odometry(room.frame(i, path(i)), T_odom)))

    assert {result.status for result in results} == {TrackingStatus.TRACKED}
    off = inverse(path(11)) @ results[-1].T_world_camera
    assert np.linalg.norm(off[:3, 3]) < 0.002 and np.degrees(angle_rad(off)) < 0.1


def test_good_odometry_carries_over_a_step_that_nothing_else_foresees(room, session):
    for i in range(3):
        session.track(with_odometry(room.frame(i, path(i)), path(i)))
    far = path(3) @ exp([0.3, 0.05, -0.2, 0.05, 0.3, 0.02])

    result = session.track(with_odometry(room.frame(3, far), far))

    off = inverse(far) @ result.T_world_camera
    assert result.status is TrackingStatus.TRACKED
    assert np.linalg.norm(off[:3, 3]) < 0.003
