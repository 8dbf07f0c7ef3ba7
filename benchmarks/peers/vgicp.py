"""small_gicp: VGICP of every frame to one voxel map, after a constant-velocity prediction."""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import NDArray

from benchmarks.peers.base import MAX_DEPTH_M, PeerPose
from shared.rectify import RgbdImage

_STRIDE_PX = 3
_SAMPLING_M = 0.03
_VOXEL_M = 0.10
_NEIGHBOURS = 10
_MAX_CORRESPONDENCE_M = 0.10
_MIN_INLIER_SHARE = 0.3


class Vgicp:
    """One map of Gaussians in voxels, grown by every frame that was registered."""

    def __init__(self) -> None:
        self._map = small_gicp.GaussianVoxelMap(_VOXEL_M)
        self._T_world_camera = np.eye(4)
        self._T_last_now = np.eye(4)
        self._is_empty = True

    def track(self, frame: RgbdImage) -> PeerPose:
        """Register to the map, then add to it."""
        source, _ = small_gicp.preprocess_points(_points(frame), _SAMPLING_M, _NEIGHBOURS)
        is_tracked = self._is_empty or self._register(source)
        if is_tracked:
            self._map.insert(source, self._T_world_camera)
            self._is_empty = False
        return PeerPose(self._T_world_camera, is_tracked)

    def _register(self, source: small_gicp.PointCloud) -> bool:
        predicted = self._T_world_camera @ self._T_last_now
        result = small_gicp.align(
            self._map,
            source,
            predicted,
            max_correspondence_distance=_MAX_CORRESPONDENCE_M,
            max_iterations=30,
        )
        if result.num_inliers < _MIN_INLIER_SHARE * source.size():
            return False
        T_world_camera = np.asarray(result.T_target_source, np.float64)
        self._T_last_now = np.linalg.inv(self._T_world_camera) @ T_world_camera
        self._T_world_camera = T_world_camera
        return bool(result.converged)


def _points(frame: RgbdImage) -> NDArray[np.float64]:
    depth = frame.depth_m[::_STRIDE_PX, ::_STRIDE_PX]
    v, u = np.nonzero((depth > 0.0) & (depth < MAX_DEPTH_M))
    z = depth[v, u].astype(np.float64)
    i = frame.intrinsics
    x = (_STRIDE_PX * u - i.cx) / i.fx * z
    y = (_STRIDE_PX * v - i.cy) / i.fy * z
    return np.stack([x, y, z], axis=1)
