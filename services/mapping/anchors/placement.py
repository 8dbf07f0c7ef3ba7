"""Where each keyframe's anchors were put: they go along when their keyframe is corrected."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from services.mapping.anchors.anchor_map import AnchorMap
from services.mapping.config import ScheduleConfig
from shared import se3


class Placement:
    """The pose of each keyframe that its anchors are placed by."""

    def __init__(self, config: ScheduleConfig) -> None:
        self._config = config
        self._poses: dict[int, NDArray[np.float64]] = {}  # T_world_camera [4, 4] by seq

    def add(self, seq: int, T_world_camera: NDArray[np.float64]) -> None:
        """A new keyframe, whose anchors are placed by this pose."""
        self._poses[seq] = T_world_camera

    def follow(self, seq: int, T_world_camera: NDArray[np.float64], anchors: AnchorMap) -> None:
        """Take a keyframe's anchors along to its new pose, if that is far enough away."""
        T_new_old = T_world_camera @ se3.inverse(self._poses[seq])
        shift_m = float(np.linalg.norm(T_world_camera[:3, 3] - self._poses[seq][:3, 3]))
        turn_deg = math.degrees(se3.angle_rad(T_new_old))
        if shift_m > self._config.min_shift_m or turn_deg > self._config.min_turn_deg:
            anchors.move(seq, T_new_old)
            self._poses[seq] = T_world_camera

    def state(self) -> dict[str, np.ndarray]:
        """Everything, as arrays."""
        return {
            "placed_seqs": np.array(list(self._poses), np.int64),
            "placed": np.array(list(self._poses.values())).reshape(-1, 4, 4),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Replace everything by a `state()`."""
        placed = state["placed"].copy()  # else each pose would keep the whole file in memory
        self._poses = dict(zip(state["placed_seqs"].tolist(), placed, strict=True))
