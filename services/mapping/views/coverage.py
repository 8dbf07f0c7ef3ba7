"""Which pixels of a new keyframe the map does not explain yet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.mapping.config import AnchorConfig
from services.mapping.rasterizer import View
from services.mapping.views.render import Painter
from shared import se3
from shared.rectify import RgbdImage


def uncovered_pixels(
    painter: Painter,
    image: RgbdImage,
    T_world_camera: NDArray[np.float64],
    config: AnchorConfig,
) -> NDArray[np.bool_]:
    """Pixels that the map leaves open or draws behind the measured surface, [H, W].

    Judged on a render of half the size: "new Gaussian points are only added to non-overlapping
    regions of the new keyframe".
    """
    height, width = image.depth_m.shape
    if len(painter.anchors) == 0:
        return np.ones((height, width), bool)
    half = image.intrinsics.scaled(0.5)
    rendered = painter.draw(View(se3.inverse(T_world_camera), half)).rendered
    is_uncovered = uncovered(
        rendered.alpha.cpu().numpy(),
        rendered.depth.cpu().numpy(),
        _resized(image.depth_m, half.height, half.width),
        config,
    )
    return _resized(is_uncovered, height, width)


def uncovered(
    alpha: NDArray[np.float32],
    depth_sum: NDArray[np.float32],
    measured_m: NDArray[np.float32],
    config: AnchorConfig,
) -> NDArray[np.bool_]:
    """Where alpha is low or the rendered depth behind the measured one, [H, W].

    Args:
        alpha, depth_sum: rendered; the sum of w z is not divided by alpha.
        measured_m: depth of the keyframe, 0 where there is none.
    """
    is_open = alpha < config.min_alpha
    limit = measured_m * (1.0 + config.min_depth_gap) + config.min_depth_gap_m
    return is_open | ((measured_m > 0) & (depth_sum > limit * np.maximum(alpha, 1e-6)))


def _resized(image: NDArray, height: int, width: int) -> NDArray:
    """The image at another size, nearest pixels."""
    rows = (2 * np.arange(height) + 1) * image.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * image.shape[1] // (2 * width)
    return image[rows[:, None], columns]
