"""How far keyframes lie from where tracking has them, for their images to lie on the map.

Tracking goes on from its own poses; the map's keyframes and the final trajectory have the offsets.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from shared import se3

_PULL = 1.0 / 3.0  # weight of tracking's pose against the image's: three quarters are followed

Offsets = Mapping[int, NDArray[np.float64]]  # T_tracked_aligned, of the camera, [4, 4] by seq


class PoseOffsets:
    """T_tracked_aligned of the keyframes that were moved, by seq."""

    def __init__(self) -> None:
        self._twists: dict[int, NDArray[np.float64]] = {}  # [6], logarithms

    def of(self, seq: int) -> NDArray[np.float64]:
        """The offset of a keyframe, [4, 4]."""
        return se3.exp(self._twists[seq]) if seq in self._twists else np.eye(4)

    def all(self) -> Offsets:
        """Every keyframe's that was moved."""
        return {seq: self.of(seq) for seq in self._twists}

    def move(self, seq: int, twist: NDArray[np.float64], rate: float) -> None:
        """Go a share of the way by which a twist [6] of T_camera_world, on its left, would."""
        moved = self.of(seq) @ se3.exp(-rate * twist)
        self._twists[seq] = (1.0 - rate * _PULL) * se3.log(moved)

    def state(self) -> list[list[float]]:
        """Everything, as numbers: seq, then the twist."""
        return [[seq, *twist.tolist()] for seq, twist in self._twists.items()]

    def restore(self, state: list[list[float]]) -> None:
        """Replace everything by a `state()`."""
        self._twists = {int(seq): np.array(twist) for seq, *twist in state}
