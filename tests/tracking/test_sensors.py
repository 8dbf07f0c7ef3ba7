"""Sensors as they are: noise, changing exposure and white balance, things that move."""

import dataclasses

import numpy as np
import pytest

from benchmarks.disturbances import MovingBox
from shared.frames import (
    HAS_POSE,
    ColourEncoding,
    ColourImage,
    DepthEncoding,
    DepthImage,
    Frame,
    TrackingStatus,
)
from shared.se3 import angle_rad, exp, inverse, log

CORNER = exp([0.0, 0.0, 0.0, 0.4, 0.8, 0.0])
STEP = np.array([0.015, -0.005, 0.01, 0.004, 0.008, -0.003])
COUNT = 40  # the third wall leaves the view at 24: two are left, along which geometry is silent


class Walk:
    """A walk through the room as a sequence."""

    def __init__(self, room) -> None:
        self.calibration = room.calibration
        self._room = room

    def __len__(self) -> int:
        return COUNT

    def true_pose(self, index: int) -> np.ndarray:
        return CORNER @ exp(index * STEP)

    def frame(self, index: int) -> Frame:
        return self._room.frame(index, self.true_pose(index))


def with_images(frame: Frame, rgb: np.ndarray, raw: np.ndarray) -> Frame:
    return dataclasses.replace(
        frame,
        rgb=ColourImage(ColourEncoding.RGB8, np.clip(rgb, 0, 255).astype(np.uint8).tobytes()),
        depth=DepthImage(DepthEncoding.RAW16, np.clip(raw, 0, 65534).astype("<u2").tobytes()),
    )


def images(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    rgb = np.frombuffer(frame.rgb.bytes, np.uint8).reshape(240, 320, 3).astype(np.float64)
    return rgb, np.frombuffer(frame.depth.bytes, "<u2").reshape(240, 320) / 5000.0


def kinect(frame: Frame) -> Frame:
    """Disparity noise of a structured-light sensor, holes at edges, a noisy camera."""
    rng = np.random.default_rng(frame.seq)
    rgb, z = images(frame)
    z = z + 0.0025 * z**2 * rng.standard_normal(z.shape)
    holes = rng.random((24, 32)) < 0.08
    z[np.kron(holes, np.ones((10, 10), bool))] = 0.0
    return with_images(frame, rgb + 3.0 * rng.standard_normal(rgb.shape), 5000.0 * z)


def phone(frame: Frame) -> Frame:
    """Smooth depth of a sparse time-of-flight sensor, wrong at a scale of 30 pixels."""
    rng = np.random.default_rng(frame.seq)
    rgb, z = images(frame)
    waves = np.kron(rng.standard_normal((8, 11)), np.ones((30, 30)))[:240, :320]
    return with_images(frame, rgb, 5000.0 * z * (1.0 + 0.004 * waves))


def brightening(frame: Frame) -> Frame:
    """Gain from a half to two, and white balance from red to blue, over the walk."""
    rgb, z = images(frame)
    gain = 0.5 * 4.0 ** (frame.seq / COUNT)
    tint = np.array([1.2, 1.0, 0.8]) ** (1.0 - 2.0 * frame.seq / COUNT)
    return with_images(frame, 0.6 * gain * tint * rgb, 5000.0 * z)


def errors_m(results, walk: Walk) -> list[float]:
    T_first = walk.true_pose(0)
    off = [
        inverse(inverse(T_first) @ walk.true_pose(i)) @ result.T_world_camera
        for i, result in enumerate(results)
    ]
    assert max(np.degrees(angle_rad(T)) for T in off) < 3.0
    return [float(np.linalg.norm(T[:3, 3])) for T in off]


@pytest.mark.parametrize(
    ("sensor", "limit_m"), [(kinect, 0.01), (phone, 0.02), (brightening, 0.003)]
)
def test_a_walk_is_tracked_whatever_the_sensor(room, session, sensor, limit_m):
    walk = Walk(room)

    results = [session.track(sensor(walk.frame(i))) for i in range(COUNT)]

    assert all(result.status in HAS_POSE for result in results)
    assert max(errors_m(results, walk)) < limit_m


def test_a_walk_behind_a_moving_third_of_the_image_stays_tracked_and_bounded(room, session):
    walk = MovingBox(Walk(room), depth_m=1.0, step_px=10.0)

    results = [session.track(walk.frame(i)) for i in range(COUNT)]

    assert {result.status for result in results} == {TrackingStatus.TRACKED}
    assert max(errors_m(results, Walk(room))) < 0.005


def nees(result, T_reference_true: np.ndarray, T_true: np.ndarray) -> float:
    """Squared error in the reference keyframe by the covariance told, a dimension."""
    twist = log(inverse(T_true) @ T_reference_true @ result.T_reference_camera)
    return float(twist @ np.linalg.solve(result.covariance, twist)) / 6.0


def test_the_covariance_told_is_that_of_the_errors_within_a_factor_of_three(room, session):
    walk = Walk(room)
    results = [session.track(kinect(walk.frame(i))) for i in range(COUNT)]

    told = [
        nees(r, walk.true_pose(r.reference_seq), walk.true_pose(r.seq))
        for r in results
        if r.reference_seq != r.seq
    ]

    assert 1 / 9 < np.mean(told) < 9.0  # three, in standard deviations
