"""The exposure of a new keyframe, from what the map drew there: a robust line per channel.

Gradient steps alone are too few to follow an exposure that jumps between keyframes: the colours of
the map would have to.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.mapping.config import ExposureConfig
from services.mapping.views.first_look import FirstLook

_ROUNDS = 6  # of reweighting
_LEAST_SPREAD = 0.02  # of the residuals: below, they are the noise of 8-bit images
_MAX_GAIN = 4.0
_COST_SCALE = 0.05
Array = NDArray[np.floating]


def fitted_exposure(
    look: FirstLook, before: NDArray[np.float32], config: ExposureConfig
) -> NDArray[np.float32] | None:
    """Gain and bias [2, 3] that turn the map's colours into the keyframe's.

    Only surfaces that the map shows at their measured depth count, where the image is neither
    black nor saturated; None where they are too few. Fits of a camera whose exposure is fixed
    would only be noise: what explains the image hardly better than `before` is not taken.

    Args:
        before: the exposure that it would have without, [2, 3].
    """
    grid = np.s_[:: config.pixel_step, :: config.pixel_step]
    is_known = _is_known(look, grid, config)
    if is_known.mean() < config.min_overlap:
        return None
    alpha = look.rendered.alpha.cpu().numpy()[grid][..., None]
    drawn = look.rendered.colour.cpu().numpy()[grid] / np.maximum(alpha, 0.5)
    drawn, seen = drawn[is_known].astype(np.float64), look.rgb[grid][is_known]
    lines = [_line(drawn[:, c], seen[:, c], before[:, c], config) for c in range(3)]
    fitted = np.stack(lines, axis=1).astype(np.float32)
    least = (1.0 - config.min_improvement) * _cost(drawn, seen, before)
    return fitted if _cost(drawn, seen, fitted) < least else before


def _is_known(
    look: FirstLook, grid: tuple[slice, slice], config: ExposureConfig
) -> NDArray[np.bool_]:
    """Pixels of a grid whose surface both show."""
    depth_m, rgb = look.depth_m[grid], look.rgb[grid]
    gap_m = np.abs(look.depth_drawn_m()[grid] - depth_m)
    is_known = look.rendered.alpha.cpu().numpy()[grid] > config.min_alpha
    is_known &= (depth_m > 0) & (gap_m < 0.02 + 0.05 * depth_m)
    return is_known & (rgb.max(axis=2) < 0.97) & (rgb.min(axis=2) > 0.02)


def _line(drawn: Array, seen: Array, before: NDArray[np.float32], config: ExposureConfig) -> Array:
    """Gain and bias of one channel by least squares with Cauchy weights, near `before`."""
    inertia = len(drawn) * np.array([config.gain_inertia, config.bias_inertia])
    columns = np.stack([drawn, np.ones_like(drawn)], axis=1)
    line = before.astype(np.float64)
    for _ in range(_ROUNDS):
        residuals = seen - columns @ line
        spread = max(1.48 * float(np.median(np.abs(residuals))), _LEAST_SPREAD)
        weighted = columns / (1.0 + (residuals / spread) ** 2)[:, None]
        normal = weighted.T @ columns + np.diag(inertia)
        line = np.linalg.solve(normal, weighted.T @ seen + inertia * before)
    line[0] = np.clip(line[0], 1.0 / _MAX_GAIN, _MAX_GAIN)
    return line


def _cost(drawn: Array, seen: Array, exposure: NDArray[np.floating]) -> float:
    """Mean residual of all channels, Cauchy's: far outliers hardly count."""
    residuals = (seen - drawn * exposure[0] - exposure[1]) / _COST_SCALE
    return float(np.log1p(residuals**2).mean())
