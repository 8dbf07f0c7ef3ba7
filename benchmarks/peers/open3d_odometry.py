"""Open3D's tensor RGB-D odometry, frame to frame, with the hybrid of depth and intensity."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from benchmarks.peers.base import MAX_DEPTH_M, Odometry, PeerPose
from benchmarks.peers.open3d_tensors import image, tensor
from shared.rectify import RgbdImage

_STAGES = (10, 5, 3)
_MAX_DEPTH_STEP_M = 0.07


class Open3dHybrid:
    """Remembers the last frame only."""

    def __init__(self) -> None:
        self._odometry = Odometry()
        self._last: o3d.t.geometry.RGBDImage | None = None

    def track(self, frame: RgbdImage) -> PeerPose:
        """The motion since the last frame, added to its pose."""
        now, last = _rgbd(frame), self._last
        self._last = now
        if last is None:
            return self._odometry.moved(np.eye(4))
        o = o3d.t.pipelines.odometry
        try:
            result = o.rgbd_odometry_multi_scale(
                now,
                last,
                tensor(frame.intrinsics.matrix()),
                tensor(np.eye(4)),
                1.0,
                MAX_DEPTH_M,
                [o.OdometryConvergenceCriteria(count) for count in _STAGES],
                o.Method.Hybrid,
                o.OdometryLossParams(_MAX_DEPTH_STEP_M),
            )
        except RuntimeError:  # a singular system: it found no motion
            return self._odometry.moved(None)
        return self._odometry.moved(result.transformation.numpy())


def _rgbd(frame: RgbdImage) -> o3d.t.geometry.RGBDImage:
    colour = frame.rgb.astype(np.float32) / 255.0
    return o3d.t.geometry.RGBDImage(image(colour), image(frame.depth_m[..., None]))
