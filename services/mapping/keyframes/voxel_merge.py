"""Clouds of several keyframes as one: what falls into one voxel and faces one way is averaged."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from shared.tracks import PointCloud


def merge_clouds(
    clouds_camera: list[PointCloud],
    T_world_cameras: list[NDArray[np.float64]],
    voxel_size_m: float,
    max_points: int,
) -> PointCloud:
    """Merge clouds in the world frame, each point weighted by the precision of its depth.

    Args:
        clouds_camera: one cloud a camera; normals of unit length.
        T_world_cameras: their poses.
        voxel_size_m: side of the voxels.
        max_points: voxels that come to sight when there are so many are left out.

    Returns:
        one point a voxel and main direction of the normal, in order of first sight.
    """
    merged_points, merged_normals = _merge_voxels(
        np.concatenate([cloud.points for cloud in clouds_camera]),
        np.concatenate([cloud.normals for cloud in clouds_camera]),
        np.cumsum([len(cloud.points) for cloud in clouds_camera]),
        np.stack(T_world_cameras),
        voxel_size_m,
        max_points,
    )
    return PointCloud(merged_points, merged_normals)


@numba.njit(cache=True, nogil=True, inline="always")
def _depth_precision(depth_m):  # pragma: no cover - compiled
    """Inverse variance of structured-light depth, 1/m^2 (Nguyen et al., 3DIMPVT 2012)."""
    sigma_m = 0.0012 + 0.0019 * max(depth_m - 0.4, 0.0) ** 2
    return 1.0 / sigma_m**2


@numba.njit(cache=True, nogil=True)
def _merge_voxels(  # noqa: C901, PLR0913 - compiled
    points, normals, ends, poses, voxel_size, limit
):  # pragma: no cover - compiled
    count = len(points)
    p, m = np.zeros(3), np.zeros(3)
    cloud = 0
    capacity = 16
    while capacity < 2 * min(count, limit):
        capacity *= 2
    keys = np.full(capacity, -1, np.int64)
    slots = np.zeros(capacity, np.int32)
    sums = np.zeros((min(count, limit), 7), np.float64)
    used = 0
    for i in range(count):
        while i >= ends[cloud]:
            cloud += 1
        for axis in range(3):
            p[axis] = poses[cloud, axis, 3]
            m[axis] = 0.0
            for j in range(3):
                p[axis] += poses[cloud, axis, j] * points[i, j]
                m[axis] += poses[cloud, axis, j] * normals[i, j]
        key = _voxel_key(p, m, voxel_size)
        slot = _first_slot(key, capacity)
        while keys[slot] != -1 and keys[slot] != key:
            slot = (slot + 1) & (capacity - 1)
        if keys[slot] == -1:
            if used == limit:
                continue
            keys[slot] = key
            slots[slot] = used
            used += 1
        row = sums[slots[slot]]
        w = _depth_precision(np.float64(points[i, 2]))
        for axis in range(3):
            row[axis] += w * p[axis]
            row[3 + axis] += w * m[axis]
        row[6] += w
    merged_points = np.empty((used, 3), np.float32)
    merged_normals = np.empty((used, 3), np.float32)
    for i in range(used):
        row = sums[i]
        length = np.sqrt(row[3] ** 2 + row[4] ** 2 + row[5] ** 2)
        for axis in range(3):
            merged_points[i, axis] = row[axis] / row[6]
            merged_normals[i, axis] = row[3 + axis] / length
    return merged_points, merged_normals


@numba.njit(cache=True, nogil=True, inline="always")
def _first_slot(key, capacity):  # pragma: no cover - compiled
    """Where to look for a voxel first; a block of 4x4x4 lies side by side, in few cache lines."""
    block = key & ~((np.int64(3) << 40) | (np.int64(3) << 20) | np.int64(3))
    offset = ((key >> 36) & 48) | ((key >> 18) & 12) | (key & 3)
    hashed = (block * np.int64(-7046029254386353131)) >> np.int64(40)
    return ((hashed << 6) | offset) & np.int64(capacity - 1)


@numba.njit(cache=True, nogil=True)
def _voxel_key(point, normal, voxel_size):  # pragma: no cover - compiled
    # Two sides of a thin wall must not be averaged, so the main direction of the normal counts.
    axis = 0
    for i in range(1, 3):
        if abs(normal[i]) > abs(normal[axis]):
            axis = i
    direction = 2 * axis + (1 if normal[axis] > 0.0 else 0)
    key = np.int64(direction)
    for i in range(3):
        key = (key << 20) | (np.int64(np.floor(point[i] / voxel_size)) & np.int64(0xFFFFF))
    return key
