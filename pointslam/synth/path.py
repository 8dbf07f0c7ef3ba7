"""A hand's path through the room: one closed, smooth loop, and views a step off it."""

from __future__ import annotations

import math

import numpy as np

from pointslam.synth.surfaces import UP, Vector
from shared import se3
from shared.se3 import Matrix

_CENTRE_M = np.array([2.35, 1.35, 1.45])
_STEP_M = 0.02  # about what a hand moves in 1/30 s
_MAX_RADIUS_M = 0.8
_SWEEP_DEG_PER_FRAME = 0.3
_MAX_SWEEP_DEG = 75.0
_PITCH_DEG = -11.0


def camera_path(num_frames: int) -> list[Matrix]:
    """`T_world_camera` of every frame; the last pose lies one step before the first.

    Speed is the same for every length: a longer path sweeps more of the room.
    """
    radius = min(num_frames * _STEP_M / (2 * math.pi), _MAX_RADIUS_M)
    sweep_deg = min(num_frames * _SWEEP_DEG_PER_FRAME, _MAX_SWEEP_DEG)
    return [_pose(2 * math.pi * i / num_frames, radius, sweep_deg) for i in range(num_frames)]


def views_off_path(path: list[Matrix], count: int, seed: int) -> list[Matrix]:
    """Poses 10 to 25 cm beside the path, turned by up to 10 degrees."""
    rng = np.random.default_rng([seed, 3])
    views = []
    for i in np.linspace(0, len(path) - 1, count + 1)[:-1].astype(int):
        direction = rng.standard_normal(3) * [1.0, 0.7, 0.5]
        aside = rng.uniform(0.10, 0.25) * direction / np.linalg.norm(direction)
        turn = np.deg2rad(rng.uniform(-10, 10, 3) * [1.0, 1.0, 0.4])
        views.append(path[i] @ se3.exp(np.r_[aside, turn]))
    return views


def look(position: Vector, yaw_rad: float, pitch_rad: float, roll_rad: float = 0.0) -> Matrix:
    """A camera at `position` that looks along +y turned by yaw to the left, pitched up."""
    forward = np.array(
        [
            -math.sin(yaw_rad) * math.cos(pitch_rad),
            math.cos(yaw_rad) * math.cos(pitch_rad),
            math.sin(pitch_rad),
        ]
    )
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    T = se3.from_rotation(np.stack([right, np.cross(forward, right), forward], 1), position)
    return T @ se3.exp([0, 0, 0, 0, 0, roll_rad])


def _pose(phase: float, radius_m: float, sweep_deg: float) -> Matrix:
    around = [math.cos(phase), 0.8 * math.sin(phase), 0.18 * math.sin(2 * phase + 0.7)]
    position = _CENTRE_M + radius_m * np.array(around)
    yaw = math.radians(-6 + sweep_deg * math.sin(phase + 0.4))
    pitch = math.radians(_PITCH_DEG + 4 * math.sin(2 * phase))
    roll = math.radians(2.5 * math.sin(phase + 1.1))
    return look(position, yaw, pitch, roll)
