"""Keyframes and landmarks as the map keeps them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shared.tracks import Observations, PointCloud


@dataclass(frozen=True)
class ViewCone:
    """What a keyframe can see, from its cloud: bounds of x/z and y/z, and depths."""

    low: NDArray[np.float64]  # [2]
    high: NDArray[np.float64]  # [2]
    far_m: float
    median_m: float

    @staticmethod
    def of(cloud_camera: PointCloud) -> ViewCone:
        """The cone of a cloud; of an empty cloud, a cone that sees nothing."""
        points = cloud_camera.points.astype(np.float64)
        if len(points) == 0:
            return ViewCone(np.zeros(2), np.zeros(2), 0.0, 1.0)
        slopes = points[:, :2] / points[:, 2:]
        depths = points[:, 2]
        return ViewCone(
            slopes.min(axis=0), slopes.max(axis=0), float(depths.max()), float(np.median(depths))
        )


@dataclass(frozen=True)
class StoredKeyframe:
    """A keyframe as the map keeps it."""

    seq: int
    t_ns: int
    T_world_camera: NDArray[np.float64]  # [4, 4], as corrected last
    observations: Observations
    cloud_camera: PointCloud
    thumbnail: NDArray[np.uint8]  # [15, 20]
    cone: ViewCone
    edge_blur_px: float = 0.0


@dataclass(frozen=True)
class LandmarkTable:
    """All landmarks of a map, by ascending id."""

    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # [L]
    positions_world: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    normals_world: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))

    def rows(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """The row of each id; -1 where the table does not hold it."""
        if len(self.ids) == 0:
            return np.full(len(ids), -1, np.int64)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return np.where(self.ids[rows] == ids, rows, -1)
