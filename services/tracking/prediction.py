"""Where the camera is expected: its own odometry, or constant velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import VerificationConfig
from services.tracking.verification import Step, step_between
from shared.frames import Frame, Prior
from shared.se3 import exp, inverse, log
from shared.tracks import TrackingContext

_MAX_EXTRAPOLATION = 3.0


def brought_up(prior: Prior, context: TrackingContext) -> Prior:
    """The prior in the map as it is now: its pose goes along with its reference keyframe."""
    if prior.T_reference_camera is None or prior.reference_seq != context.reference_seq:
        return prior
    T_world_camera = context.T_world_reference @ prior.T_reference_camera
    return replace(prior, T_world_camera=T_world_camera)


def predict(prior: Prior, frame: Frame) -> NDArray[np.float64]:
    """Expected pose of a frame, T_world_camera, [4, 4]; a repeat is expected where it was."""
    if prior.frame_digest == frame.digest():
        return prior.T_world_camera.copy()
    if prior.T_odom_camera is not None and frame.T_odom_camera is not None:
        last, now = prior.T_odom_camera.matrix(), frame.T_odom_camera.matrix()
        return prior.T_world_camera @ inverse(last) @ now
    return prior.T_world_camera @ _constant_velocity(prior, frame)


def is_predictable(prior: Prior, frame: Frame, config: VerificationConfig) -> bool:
    """Whether a frame is expected about where it will be: by odometry, or after a small step."""
    if prior.frame_digest == frame.digest():
        return True
    if prior.T_odom_camera is not None and frame.T_odom_camera is not None:
        return True
    expected = step_between(np.eye(4), _constant_velocity(prior, frame))
    near = Step(config.near_step_m, config.near_step_deg)
    return _has_velocity(prior, frame) and expected.is_within(near)


def turned_starts(
    T_world_camera: NDArray[np.float64], turn_deg: float
) -> list[NDArray[np.float64]]:
    """A predicted pose turned both ways about each axis of the camera, six [4, 4].

    A hand turns faster than it walks: from far off in angle a registration slides along a wall.
    """
    twists = np.radians(turn_deg) * np.concatenate([np.eye(3), -np.eye(3)])
    return [T_world_camera @ exp(np.concatenate([np.zeros(3), twist])) for twist in twists]


def _constant_velocity(prior: Prior, frame: Frame) -> NDArray[np.float64]:
    """T_last_now, if the last motion goes on; nothing where it is too old to go by."""
    if not _has_velocity(prior, frame):
        return np.eye(4)
    ratio = (frame.t_ns - prior.t_ns) / prior.before_last_dt_ns
    return exp(ratio * log(prior.T_before_last))


def _has_velocity(prior: Prior, frame: Frame) -> bool:
    """Whether the last motion is known and recent."""
    if prior.before_last_dt_ns <= 0 or prior.lost_frames > 0:
        return False
    return 0.0 < (frame.t_ns - prior.t_ns) / prior.before_last_dt_ns <= _MAX_EXTRAPOLATION
