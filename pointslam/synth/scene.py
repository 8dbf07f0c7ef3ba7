"""Surfaces packed into arrays that compiled code walks: geometry, and textures with mip levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pointslam.synth.surfaces import Surface

MIP_LEVELS = 4


@dataclass(frozen=True)
class Scene:
    """Q rectangles. Level l of a texture is halved l times; `texels` holds all, end to end."""

    geometry: NDArray[np.float64]  # [Q, 14]: origin, right, down, normal, width, height
    texels: NDArray[np.uint8]
    offsets: NDArray[np.int64]  # [Q, MIP_LEVELS], into texels
    shapes: NDArray[np.int64]  # [Q, MIP_LEVELS, 2], rows and columns


def pack_scene(surfaces: Sequence[Surface]) -> Scene:
    """Lay surfaces out for compiled code."""
    geometry = np.array(
        [np.r_[s.origin, s.right, s.down, s.normal, s.width_m, s.height_m] for s in surfaces]
    )
    levels = [_pyramid(s.texture) for s in surfaces]
    flat = [level for pyramid in levels for level in pyramid]
    starts = np.cumsum([0, *(level.size for level in flat)])[:-1]
    shapes = np.array([level.shape[:2] for level in flat], np.int64)
    return Scene(
        geometry=np.ascontiguousarray(geometry),
        texels=np.concatenate([level.ravel() for level in flat]),
        offsets=starts.reshape(-1, MIP_LEVELS).astype(np.int64),
        shapes=shapes.reshape(-1, MIP_LEVELS, 2),
    )


def _pyramid(texture: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    levels = [np.ascontiguousarray(texture)]
    for _ in range(MIP_LEVELS - 1):
        rows, columns = levels[-1].shape[:2]
        size = (max(columns // 2, 1), max(rows // 2, 1))
        levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA).astype(np.uint8))
    return levels
