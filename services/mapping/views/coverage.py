"""Which pixels of a new keyframe the map does not explain yet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.mapping.config import AnchorConfig
from services.mapping.views.first_look import FirstLook


def uncovered_pixels(look: FirstLook, config: AnchorConfig) -> NDArray[np.bool_]:
    """Pixels of a look that the map leaves open or draws behind the measured surface, [H, W].

    "New Gaussian points are only added to non-overlapping regions of the new keyframe".
    """
    alpha, depth_sum = look.rendered.alpha, look.rendered.depth
    return uncovered(alpha.cpu().numpy(), depth_sum.cpu().numpy(), look.depth_m, config)


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
