"""Single frames of a colour video, by number."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.errors import SequenceError

_MAX_SKIP = 120  # frames that are decoded and thrown away rather than sought over
_MAX_MISSING = 60  # frames that a header may promise beyond the last one


class Video:
    """A video file; reading in order decodes each frame once, reading elsewhere seeks.

    Frames may be asked for from several threads, one at a time.
    """

    def __init__(self, path: Path) -> None:
        """Open a video.

        Raises:
            SequenceError: no decoder reads it.
        """
        self._path = path
        self._lock = threading.Lock()
        self._capture = self._open()
        self._next = 0  # number of the frame that the decoder gives next
        self._length = self._count()

    def __len__(self) -> int:
        return self._length

    def frame(self, number: int) -> NDArray[np.uint8]:
        """Frame `number`, [H, W, 3] RGB; SequenceError where the video cannot be decoded."""
        with self._lock:
            bgr = self._read(number)
        if bgr is None:
            raise SequenceError(self._path, f"ends or is damaged before frame {number}")
        return np.ascontiguousarray(bgr[..., ::-1])

    def _count(self) -> int:
        # Containers promise a number that comes of a duration and a rate, so it may be too large.
        promised = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        for number in range(promised - 1, max(promised - 1 - _MAX_MISSING, -1), -1):
            if self._read(number) is not None:
                return number + 1
        raise SequenceError(self._path, f"promises {promised} frames, but they do not decode")

    def _read(self, number: int) -> NDArray[np.uint8] | None:
        self._go_to(number)
        if self._next != number:
            return None
        is_read, bgr = self._capture.read()
        self._next += is_read
        return bgr.astype(np.uint8, copy=False) if is_read else None

    def _go_to(self, number: int) -> None:
        if not 0 <= number - self._next <= _MAX_SKIP:
            self._seek(number)
        while self._next < number and self._capture.grab():
            self._next += 1

    def _seek(self, number: int) -> None:
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, number)
        self._next = number
        if int(self._capture.get(cv2.CAP_PROP_POS_FRAMES)) != number:  # no index in the file
            self._capture.release()
            self._capture = self._open()
            self._next = 0

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise SequenceError(self._path, "is no video that OpenCV's FFmpeg decodes")
        return capture
