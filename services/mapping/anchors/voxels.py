"""Voxels that anchors fill: their size grows with the depth that they were seen at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.mapping.config import AnchorConfig

MIN_LEVEL, MAX_LEVEL = -2, 3
_AXIS_BITS = 19
_CENTRE = 1 << (_AXIS_BITS - 1)
_MASK = (1 << _AXIS_BITS) - 1


def levels_at(depths_m: NDArray[np.floating], config: AnchorConfig) -> NDArray[np.int64]:
    """Level of a voxel seen at a depth: its side is voxel_size_m * 2 ** level. [N]."""
    ratio = np.maximum(depths_m, 0.2) / config.reference_depth_m
    return np.clip(np.round(np.log2(ratio)), MIN_LEVEL, MAX_LEVEL).astype(np.int64)


def sizes_m(levels: NDArray[np.int64], config: AnchorConfig) -> NDArray[np.float32]:
    """Side of the voxels of these levels, metres, [N]."""
    return (config.voxel_size_m * 2.0**levels).astype(np.float32)


def voxel_keys(
    points_world: NDArray[np.floating], levels: NDArray[np.int64], config: AnchorConfig
) -> NDArray[np.int64]:
    """One number per voxel and level: level, x, y, z from the highest bits down, [N]."""
    cells = np.floor(points_world / sizes_m(levels, config)[:, None]).astype(np.int64)
    x, y, z = ((cells + _CENTRE) & _MASK).T
    packed = (x << (2 * _AXIS_BITS)) | (y << _AXIS_BITS) | z
    return ((levels - MIN_LEVEL) << (3 * _AXIS_BITS)) | packed


def level_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The level that a key names, [N]."""
    return (keys >> (3 * _AXIS_BITS)) + MIN_LEVEL


def centres(
    points_world: NDArray[np.floating], levels: NDArray[np.int64], config: AnchorConfig
) -> NDArray[np.float32]:
    """Centre of the voxel around each point, world, metres, [N, 3]."""
    sides = sizes_m(levels, config)[:, None]
    return ((np.floor(points_world / sides) + 0.5) * sides).astype(np.float32)
