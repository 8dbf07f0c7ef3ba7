"""The local map as voxels of several sizes: in each, one plane for each way that it may face."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from shared.tracks import PointCloud


@dataclass(frozen=True)
class VoxelLevel:
    """An open-addressing hash table of planes (mean point, mean normal)."""

    voxel_size_m: float
    keys: NDArray[np.int64]  # [capacity], -1 where empty
    rows: NDArray[np.int32]  # [capacity], row of the plane
    planes: NDArray[np.float32]  # [V, 6], mean point and unit normal: one look into memory for both

    @property
    def points(self) -> NDArray[np.float32]:
        """Mean points, [V, 3]."""
        return self.planes[:, :3]

    @property
    def normals(self) -> NDArray[np.float32]:
        """Mean normals, unit, [V, 3]."""
        return self.planes[:, 3:]


@dataclass(frozen=True)
class VoxelMap:
    """A cloud at every level, coarse to fine."""

    levels: tuple[VoxelLevel, ...]


def build_voxel_map(cloud: PointCloud, voxel_sizes_m: tuple[float, ...]) -> VoxelMap:
    """Voxels of a cloud, the same for the same cloud to the bit."""
    levels: list[VoxelLevel] = []
    points, normals = cloud.points, cloud.normals
    counts = np.ones(len(points), np.float32)
    # Sizes are multiples of the finest one, so what shares a small voxel shares the larger ones.
    for size in reversed(voxel_sizes_m):
        keys, rows, planes, normals, counts = _fill(points, normals, counts, size)
        levels.append(VoxelLevel(size, keys, rows, planes))
        points = planes[:, :3]
    return VoxelMap(tuple(reversed(levels)))


@numba.njit(cache=True, nogil=True, inline="always")
def main_axis(x, y, z):  # pragma: no cover - compiled
    """Index 0 to 5 of the axis direction nearest to a normal."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        return 1 if x > 0.0 else 0
    if ay >= az:
        return 3 if y > 0.0 else 2
    return 5 if z > 0.0 else 4


@numba.njit(cache=True, nogil=True, inline="always")
def cell_key(direction, i, j, k):  # pragma: no cover - compiled
    """A voxel and a main axis as one number (20 bits an index)."""
    mask = np.int64(0xFFFFF)
    key = (np.int64(direction) << 20) | (np.int64(i) & mask)
    key = (key << 20) | (np.int64(j) & mask)
    return (key << 20) | (np.int64(k) & mask)


@numba.njit(cache=True, nogil=True, inline="always")
def find_slot(keys, key):  # pragma: no cover - compiled
    """The slot that holds the key, or the empty one where it would go."""
    mask = np.int64(len(keys) - 1)
    # A block of 4x4x4 voxels lies side by side: neighbours share cache lines.
    block = key & ~((np.int64(3) << 40) | (np.int64(3) << 20) | np.int64(3))
    offset = ((key >> 36) & 48) | ((key >> 18) & 12) | (key & 3)
    mixed = (block ^ (block >> 33)) * np.int64(-49064778989728563)  # as MurmurHash3 ends
    slot = (((mixed ^ (mixed >> 33)) << 6) | offset) & mask
    while keys[slot] != -1 and keys[slot] != key:
        slot = (slot + 65) & mask  # the block after: what meets another block has it whole
    return slot


@numba.njit(cache=True, nogil=True)
def _compact(keys, rows, used):  # pragma: no cover - compiled
    """The same table in no more memory than its voxels need: look-ups stay in the cache."""
    capacity = 16
    while capacity < 3 * used:
        capacity *= 2
    small_keys = np.full(capacity, -1, np.int64)
    small_rows = np.zeros(capacity, np.int32)
    for n in range(len(keys)):
        if keys[n] != -1:
            slot = find_slot(small_keys, keys[n])
            small_keys[slot] = keys[n]
            small_rows[slot] = rows[n]
    return small_keys, small_rows


@numba.njit(cache=True, nogil=True)
def _fill(points, normals, counts, voxel_size):  # pragma: no cover - compiled
    """Means of points that stand for `counts` each, with the sums of their normals."""
    count = len(points)
    capacity = 16
    while capacity <= count:
        capacity *= 2
    keys = np.full(capacity, -1, np.int64)
    rows = np.zeros(capacity, np.int32)
    sums = np.zeros((count, 7))
    used = 0
    for n in range(count):
        key = cell_key(
            main_axis(normals[n, 0], normals[n, 1], normals[n, 2]),
            np.floor(points[n, 0] / voxel_size),
            np.floor(points[n, 1] / voxel_size),
            np.floor(points[n, 2] / voxel_size),
        )
        slot = find_slot(keys, key)
        if keys[slot] == -1:
            keys[slot] = key
            rows[slot] = used
            used += 1
        row = sums[rows[slot]]
        for axis in range(3):
            row[axis] += counts[n] * points[n, axis]
            row[3 + axis] += normals[n, axis]
        row[6] += counts[n]
    keys, rows = _compact(keys, rows, used)
    planes = np.empty((used, 6), np.float32)
    totals = np.empty(used, np.float32)
    for n in range(used):
        row = sums[n]
        totals[n] = row[6]
        length = np.sqrt(row[3] ** 2 + row[4] ** 2 + row[5] ** 2)
        for axis in range(3):
            planes[n, axis] = row[axis] / row[6]
            planes[n, 3 + axis] = row[3 + axis] / length
    return keys, rows, planes, sums[:used, 3:6].astype(np.float32), totals
