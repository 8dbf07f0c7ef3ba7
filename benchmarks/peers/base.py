"""What a peer is: frames in order in, a pose for each out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shared.rectify import RgbdImage

MAX_DEPTH_M = 8.0  # as ours: cutting at 4 m was measured to cost VGICP everything


@dataclass(frozen=True)
class PeerPose:
    """A peer's answer to one frame."""

    T_world_camera: NDArray[np.float64]  # [4, 4]
    is_tracked: bool  # as the peer itself says


class Peer(Protocol):
    """A tracker with its own memory; the first frame is the origin."""

    def track(self, frame: RgbdImage) -> PeerPose:
        """The pose of the next frame."""
        ...


class Odometry:
    """Poses from motions: the last pose is repeated where a motion is not found."""

    def __init__(self) -> None:
        self._T_world_camera = np.eye(4)

    def moved(self, T_last_now: NDArray[np.float64] | None) -> PeerPose:
        """The pose after a motion; None where there is none."""
        if T_last_now is None or not np.isfinite(T_last_now).all():
            return PeerPose(self._T_world_camera, False)
        self._T_world_camera = self._T_world_camera @ T_last_now
        return PeerPose(self._T_world_camera, True)
