"""A recorded sequence with its truth, as tracking takes it frame by frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pointslam.datasets import is_held_out, open_sequence
from shared.errors import SequenceError
from shared.frames import DepthEncoding, DepthImage, Frame

_FEWEST_POSES = 3  # two can be aligned to anything
_HOLDOUT = 8  # as an evaluation run


class TrueSequence:
    """A sequence of any known format, some of whose frames have true poses at least.

    As of a sensor that sees no farther than `max_depth_m`, or fails after so many `depth_frames`.

    Raises:
        SequenceError: it cannot be read, or hardly any frame has a true pose.
    """

    def __init__(self, path: Path, max_depth_m: float = 20.0, depth_frames: float = np.inf) -> None:
        self._sequence = sequence = open_sequence(path)
        self._depth_frames = depth_frames
        nearest_m = min(max_depth_m, sequence.calibration.max_depth_m)
        self.calibration = replace(sequence.calibration, max_depth_m=nearest_m)
        self._true_poses = [sequence.truth(index) for index in range(len(sequence))]
        known = sum(pose is not None for pose in self._true_poses)
        if known < _FEWEST_POSES:
            raise SequenceError(path, f"{known} of {len(sequence)} frames have a true pose")

    def __len__(self) -> int:
        return len(self._sequence)

    def frame(self, index: int) -> Frame:
        """One frame; every eighth is held out of the map, as an evaluation run does."""
        recorded = self._sequence.frame(index)
        return Frame(
            seq=index,
            t_ns=recorded.t_ns,
            rgb=recorded.rgb,
            depth=recorded.depth if index < self._depth_frames else self._no_depth(),
            may_be_keyframe=not is_held_out(index, _HOLDOUT),
        )

    def _no_depth(self) -> DepthImage:
        size = (self.calibration.depth or self.calibration.colour).intrinsics
        return DepthImage(DepthEncoding.RAW16, bytes(2 * size.width * size.height))

    def true_pose(self, index: int) -> NDArray[np.float64]:
        """T_world_camera of a frame, [4, 4]; NaN where nobody knows it."""
        pose = self._true_poses[index]
        return np.full((4, 4), np.nan) if pose is None else pose
