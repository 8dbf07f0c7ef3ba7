"""OpenCV's RGB-D odometry, frame to frame; in the wheel that we need anyway."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.base import MAX_DEPTH_M, Odometry, PeerPose
from shared.rectify import RgbdImage

_MAX_STEP_M = 0.5
_MAX_TURN_DEG = 30.0


class OpencvOdometry:
    """Remembers the last frame only."""

    def __init__(self) -> None:
        self._odometry = Odometry()
        self._last: tuple[NDArray, NDArray] | None = None

    def track(self, frame: RgbdImage) -> PeerPose:
        """The motion since the last frame, added to its pose."""
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(frame.intrinsics.matrix().astype(np.float32))
        settings.setMaxDepth(MAX_DEPTH_M)
        settings.setMaxTranslation(_MAX_STEP_M)
        settings.setMaxRotation(_MAX_TURN_DEG)
        odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
        # Depth above its range gave exactly no motion and success, so such pixels have none.
        in_range = (frame.depth_m > 0.0) & (frame.depth_m <= MAX_DEPTH_M)
        depth = np.where(in_range, frame.depth_m, np.nan).astype(np.float32)
        now, last = (depth, np.ascontiguousarray(frame.rgb)), self._last
        self._last = now
        if last is None:
            return self._odometry.moved(np.eye(4))
        is_found, T_last_now = odometry.compute(*now, *last)
        return self._odometry.moved(np.asarray(T_last_now, np.float64) if is_found else None)
