"""An iPhone or iPad over USB with the app Record3D, by the package record3d (extra `record3d`)."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pointslam.bridges.source import CameraFrame
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import ConfigError, UnavailableError

DEPTH_SCALE = 4000.0  # units per metre: a quarter of a millimetre, up to 16 m
_FIRST_FRAME_S = 10.0
_MAX_RAW = 65535


class Record3D:
    """The first device whose app streams.

    Raises:
        ConfigError: the package is not installed.
        UnavailableError: no device is plugged in, or its app sends nothing.
    """

    def __init__(self) -> None:
        try:
            stream = importlib.import_module("record3d").Record3DStream
        except ImportError as error:
            install = "Record3D needs: pip install 'pointslam[record3d]'"
            raise ConfigError(f"{install} ({error})") from None
        devices = stream.get_connected_devices()
        if not devices:
            raise UnavailableError("no device is plugged in whose app Record3D streams over USB")
        self._new, self._ended = threading.Event(), threading.Event()
        self._stream = stream()
        self._stream.on_new_frame = self._new.set
        self._stream.on_stream_stopped = self._end
        self._stream.connect(devices[0])
        if not self._new.wait(_FIRST_FRAME_S):
            raise UnavailableError(f"the app sent no frame within {_FIRST_FRAME_S:.0f} s")
        self.calibration = calibration_of(
            self._stream.get_intrinsic_mat(),
            self._stream.get_rgb_frame().shape,
            self._stream.get_depth_frame().shape,
        )

    def frames(self) -> Iterator[CameraFrame]:
        """Frames until the app stops; times are this machine's clock."""
        while self._new.wait() and not self._ended.is_set():
            self._new.clear()
            rgb, depth_m = self._stream.get_rgb_frame(), self._stream.get_depth_frame()
            yield CameraFrame(time.monotonic_ns(), np.array(rgb), raw_depth(depth_m))

    def close(self) -> None:
        """Stop streaming."""
        self._stream.disconnect()

    def _end(self) -> None:
        self._ended.set()
        self._new.set()


def calibration_of(
    matrix: Any, colour_shape: tuple[int, ...], depth_shape: tuple[int, ...]
) -> Calibration:
    """The device, of the app's intrinsics, which are those of the colour image.

    Depth is of the same camera at a size of its own.
    """
    height, width = colour_shape[:2]
    colour = Intrinsics(matrix.fx, matrix.fy, matrix.tx, matrix.ty, width, height)
    if depth_shape == (height, width):
        return Calibration(Camera(colour), DEPTH_SCALE)
    return Calibration(Camera(colour), DEPTH_SCALE, Camera(colour.scaled(depth_shape[1] / width)))


def raw_depth(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Metres as raw values; 0 where there is no reading."""
    raw = np.rint(np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0) * DEPTH_SCALE)
    return np.where((raw > 0) & (raw < _MAX_RAW), raw, 0).astype(np.uint16)
