"""Removing anchors that hang in space which a new keyframe looks through.

Where a sensor reads nothing, anchors start at the depth around the hole: right for the view that
made them, but from elsewhere a wrong guess hides known surfaces. The mixed depths that sensors read
at the edges of objects do the same.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from services.mapping.anchors.anchor_map import AnchorMap
from services.mapping.config import AnchorConfig
from shared import se3
from shared.rectify import RgbdImage

# Less than what lies beyond the border for `erode`, the largest float.
_NO_READING_M = np.float32(1e30)


def carve(
    anchors: AnchorMap,
    image: RgbdImage,
    T_world_camera: NDArray[np.float64],
    config: AnchorConfig,
) -> int:
    """Remove the secondary anchors in front of what a keyframe measures; returns how many."""
    positions = anchors.rows["position"].cpu().numpy()
    is_carved = seen_through(positions, image, T_world_camera, config)
    is_carved &= ~anchors.rows["is_primary"].cpu().numpy()
    if is_carved.any():
        anchors.keep(torch.from_numpy(~is_carved).to(anchors.device))
    return int(is_carved.sum())


def seen_through(
    positions: NDArray[np.float32],
    image: RgbdImage,
    T_world_camera: NDArray[np.float64],
    config: AnchorConfig,
) -> NDArray[np.bool_]:
    """Whether every reading around a position's pixel is well behind it, [N].

    Args:
        positions: world, metres, [N, 3].
        image: the readings; a position without any around its pixel is not judged.
        T_world_camera: pose of the image.
        config: what counts as well behind, and around.
    """
    camera = image.intrinsics
    points = se3.transform(se3.inverse(T_world_camera), positions)
    in_front = np.flatnonzero(points[:, 2] > 0)
    x, y, z = points[in_front].T
    columns = np.round(x / z * camera.fx + camera.cx)
    rows = np.round(y / z * camera.fy + camera.cy)
    is_inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    nearest = nearest_around(image.depth_m, config.carve_window_px)
    measured = nearest[rows[is_inside].astype(np.int64), columns[is_inside].astype(np.int64)]
    limit = z[is_inside] * (1.0 + config.min_depth_gap) + config.min_depth_gap_m
    is_through = np.zeros(len(positions), bool)
    is_through[in_front[is_inside]] = measured > limit
    return is_through


def nearest_around(depth_m: NDArray[np.float32], window_px: int) -> NDArray[np.float32]:
    """The least reading in a window around each pixel, [H, W]; 0 where there is none."""
    known = np.where(depth_m > 0, depth_m, _NO_READING_M)
    nearest = cv2.erode(known, np.ones((window_px, window_px), np.uint8))
    return np.where(nearest < _NO_READING_M, nearest, np.float32(0.0))
