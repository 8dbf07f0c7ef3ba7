"""Whole walks that come back, and one that only seems to."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.tracking_run import absolute_error
from shared.camera import Calibration, Camera
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage, Frame
from shared.se3 import angle_rad, exp, inverse

TURN = np.radians(8.0)
TURNS = 54  # of 45 that are once around


def around(step: int) -> np.ndarray:
    """A camera that looks down a little and turns on the spot, at an arm's length."""
    yaw = exp([0.0, 0.0, 0.0, 0.0, step * TURN, 0.0])
    return yaw @ exp([0.0, 0.0, 0.0, -0.35, 0.0, 0.0]) @ exp([0.0, 0.0, 0.35, 0.0, 0.0, 0.0])


def final_poses(session, results) -> np.ndarray:
    return np.stack([session.store.pose(r.reference_seq) @ r.T_reference_camera for r in results])


def mean_angle_deg(poses: np.ndarray, truth: np.ndarray) -> float:
    """From the first camera, which holds the world."""
    true = inverse(truth[0]) @ truth
    return float(np.mean([np.degrees(angle_rad(T)) for T in inverse(true) @ poses]))


@pytest.fixture(scope="module")
def once_around(room, new_session):
    """Online poses, final ones, the truth and the session; the focal length is 1 % off."""
    camera = replace(room.intrinsics, fx=1.01 * room.intrinsics.fx, fy=1.01 * room.intrinsics.fy)
    calibration = Calibration(Camera(camera), room.calibration.depth_scale)
    session = new_session(calibration=calibration)
    results = [session.track(room.frame(i, around(i))) for i in range(TURNS)]
    truth = np.stack([around(i) for i in range(TURNS)])
    online = np.stack([result.T_world_camera for result in results])
    return online, final_poses(session, results), truth, session


def test_a_walk_that_comes_back_with_drift_closes_its_loop(once_around):
    *_, session = once_around

    assert session.store.num_loops >= 1


def test_after_the_loop_the_trajectory_is_better_than_what_was_told_online(once_around):
    online, final, truth, _ = once_around

    assert absolute_error(final, truth) < absolute_error(online, truth)
    assert mean_angle_deg(final, truth) < 0.9 * mean_angle_deg(online, truth)


PERIOD_M = 1.0


def corridor(z_m: float, intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Grey and depth of a wall and the floor beside it, from a place along an endless corridor.

    Their texture comes again after every metre, to the pixel.
    """
    i = intrinsics
    u, v = np.meshgrid(np.arange(i.width), np.arange(i.height))
    rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones(u.shape)], axis=-1)
    depth = np.minimum(1.2, 0.5 / np.maximum(rays[..., 1], 1e-6))
    points = rays * depth[..., None] + [z_m % PERIOD_M, 0.0, 0.0]
    cells = np.floor(points / 0.05 + 0.3).astype(np.int64)
    cells[..., 0] %= round(PERIOD_M / 0.05)
    noise = (cells @ np.array([7919, 104729, 1299709])) * 2654435761 >> 7 & 0xFF
    return noise.astype(np.uint8), depth.astype(np.float32)


def corridor_frame(seq: int, z_m: float, calibration: Calibration) -> Frame:
    grey, depth = corridor(z_m, calibration.colour.intrinsics)
    raw = np.round(depth * calibration.depth_scale).astype("<u2")
    return Frame(
        seq=seq,
        t_ns=seq * 33_000_000,
        rgb=ColourImage(ColourEncoding.RGB8, np.repeat(grey[..., None], 3, axis=-1).tobytes()),
        depth=DepthImage(DepthEncoding.RAW16, raw.tobytes()),
    )


def test_places_that_look_alike_close_no_loop(session):
    way = 0.06 * np.arange(75)  # four and a half times the period

    results = [session.track(corridor_frame(i, z, session.calibration)) for i, z in enumerate(way)]

    told = np.array([result.T_world_camera[0, 3] for result in results])
    assert session.store.num_loops == 0
    np.testing.assert_allclose(told, way, atol=0.02)
