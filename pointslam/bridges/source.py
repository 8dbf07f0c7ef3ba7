"""What gives frames: a camera, or a recording that is played at its own pace."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pointslam.datasets import Sequence
from shared.camera import Calibration
from shared.frames import ColourImage, DepthImage


@dataclass(frozen=True)
class CameraFrame:
    """One frame: arrays as `Session.frame` takes them, or encoded images."""

    t_ns: int
    rgb: NDArray[np.uint8] | ColourImage  # [H, W, 3]
    depth: NDArray[np.uint16] | DepthImage  # [H, W], raw


class Source(Protocol):
    """A device with colour and depth."""

    @property
    def calibration(self) -> Calibration:
        """Of both cameras."""
        ...

    def frames(self) -> Iterator[CameraFrame]:
        """Frames as they come; ends when the device does."""
        ...

    def close(self) -> None:
        """Let go of the device."""
        ...


class RecordedSource:
    """A sequence, each frame when its time has come."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence

    @property
    def calibration(self) -> Calibration:
        """The sequence's."""
        return self._sequence.calibration

    def frames(self) -> Iterator[CameraFrame]:
        """All frames; the first at once."""
        start_s, first_ns = time.monotonic(), self._sequence.t_ns(0)
        for index in range(len(self._sequence)):
            frame = self._sequence.frame(index)
            due_s = start_s + 1e-9 * (frame.t_ns - first_ns)
            time.sleep(max(0.0, due_s - time.monotonic()))
            yield CameraFrame(frame.t_ns, frame.rgb, frame.depth)

    def close(self) -> None:
        """Nothing is held."""
