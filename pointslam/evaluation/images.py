"""How alike two pictures are: PSNR, plain SSIM as in 3D Gaussian splatting, depth error."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Rgb = NDArray[np.uint8]

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2
_MIN_MSE = 1e-10  # identical pictures score 100 dB, not infinity
_MIN_ALPHA = 128


def psnr_db(rendered: Rgb, truth: Rgb, mask: NDArray[np.bool_] | None = None) -> float | None:
    """Peak signal to noise ratio, dB, over the pixels of `mask` [H, W]; None if it has none."""
    squared = (rendered.astype(np.float32) - truth.astype(np.float32)) ** 2 / 255.0**2
    if mask is not None:
        squared = squared[mask]
    if squared.size == 0:
        return None
    return float(-10.0 * np.log10(max(float(squared.mean(dtype=np.float64)), _MIN_MSE)))


def ssim(rendered: Rgb, truth: Rgb) -> float:
    """Mean structural similarity (Wang et al. 2004), window 11x11, sigma 1.5, zeros outside.

    Single scale, per channel, without a mask: what 3D Gaussian splatting prints.
    """
    x, y = rendered.astype(np.float32) / 255.0, truth.astype(np.float32) / 255.0
    mean_x, mean_y = _blur(x), _blur(y)
    variance_x = _blur(x * x) - mean_x**2
    variance_y = _blur(y * y) - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2 * covariance + _C2) / (variance_x + variance_y + _C2)
    return float((luminance * structure).mean(dtype=np.float64))


def depth_l1_m(
    rendered_m: NDArray[np.float32], alpha: NDArray[np.uint8], truth_m: NDArray[np.float32]
) -> float | None:
    """Mean depth error where there is true depth and the map is more than half opaque."""
    valid = (truth_m > 0) & (alpha >= _MIN_ALPHA)
    if not valid.any():
        return None
    return float(np.abs(rendered_m[valid] - truth_m[valid]).mean(dtype=np.float64))


def masked(rgb: Rgb, depth_m: NDArray[np.float32]) -> Rgb:
    """Colour times (depth > 0): pixels without depth are black, as GS-ICP SLAM scores."""
    return rgb * (depth_m > 0)[..., None].astype(np.uint8)


def _blur(image: NDArray[np.floating]) -> NDArray[np.float32]:
    kernel = cv2.getGaussianKernel(_WINDOW, _SIGMA, cv2.CV_32F)
    blurred = cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    return blurred.astype(np.float32, copy=False)
