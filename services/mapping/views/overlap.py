"""Which keyframes see what a new one sees."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.rectify import RgbdImage
from shared.se3 import inverse, transform

_STRIDE_PX = 16


def points_of(image: RgbdImage, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """A coarse grid of the measured points of an image, world, metres, [P, 3]."""
    half, camera = _STRIDE_PX // 2, image.intrinsics
    depth_m = image.depth_m[half::_STRIDE_PX, half::_STRIDE_PX].astype(np.float64)
    rows, columns = np.nonzero(depth_m > 0.0)
    u, v = columns * _STRIDE_PX + half, rows * _STRIDE_PX + half
    rays = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))]
    return transform(T_world_camera, np.stack(rays, 1) * depth_m[rows, columns][:, None])


def share_inside(
    points_world: NDArray[np.float64], T_world_camera: NDArray[np.float64], camera: Intrinsics
) -> float:
    """Share of points [P, 3] that fall into a camera's image, hidden or not; 0 without points."""
    if len(points_world) == 0:
        return 0.0
    x, y, z = transform(inverse(T_world_camera), points_world).T
    depth = np.maximum(z, 1e-6)
    u, v = x / depth * camera.fx + camera.cx, y / depth * camera.fy + camera.cy
    is_inside = (z > 0) & (u > -0.5) & (u < camera.width - 0.5)
    is_inside &= (v > -0.5) & (v < camera.height - 0.5)
    return float(is_inside.mean())


def overlapping(
    image: RgbdImage,
    T_world_camera: NDArray[np.float64],
    others: Iterable[tuple[int, NDArray[np.float64]]],
    min_share: float,
) -> list[int]:
    """Seqs of the views (seq, T_world_camera) that `min_share` of an image's points fall into."""
    points = points_of(image, T_world_camera)
    return [
        seq for seq, pose in others if share_inside(points, pose, image.intrinsics) >= min_share
    ]
