"""How blurred an image is, from its edges: motion blurs all edges that lie across it.

The gradient of a step edge under a Gaussian of known width tells how wide the edge was before
(Zhuo and Sim, Pattern Recognition 2011). A ratio of gradients at one place knows neither contrast
nor exposure, and the sharper edges of a direction know little of what else the image shows.
"""

from __future__ import annotations

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

_FINE_PX = 1.0
_COARSE_PX = 2.0  # both: standard deviations of the Gaussians
_DIRECTIONS = 8
_STRONGEST = 0.9  # quantile of the gradients above which there is an edge
_MAX_WIDTH_PX = 6.0  # beyond it the ratio says no more than that
_SHARPEST = 0.75  # quantile of the ratios: soft shadows and round things are left out
_MIN_EDGE_PIXELS = 60  # of a direction, to tell anything by it
_CREST = 0.6  # of the squared gradient beside it: the flanks of an edge tell another width
_MIN_GRADIENT = 16.0  # of a Sobel kernel: below it 8 bit images are steps


def edge_blur_px(rgb: NDArray[np.uint8]) -> float:
    """Standard deviation of the blur of an image's edges, in the direction where it is worst.

    About 1 for a sharp image, a third of its length for a motion of some pixels; 0 without edges.
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    fine = cv2.GaussianBlur(grey, (7, 7), _FINE_PX)
    coarse = cv2.GaussianBlur(fine, (11, 11), float(np.sqrt(_COARSE_PX**2 - _FINE_PX**2)))
    (fx, fy), (cx, cy) = gradients(fine), gradients(coarse)
    strength = cx * cx + cy * cy
    least = max(np.quantile(strength[::2, ::2], _STRONGEST), _MIN_GRADIENT**2)
    cx, cy, ratios = _on_edges(strength, (fx, fy), (cx, cy), np.float32(least))
    directions = np.floor(np.arctan2(cy, cx) * (_DIRECTIONS / np.pi)).astype(np.int64) % _DIRECTIONS
    widths = [_width_px(ratios[directions == k]) for k in range(_DIRECTIONS)]
    return max(widths)


@numba.njit(cache=True, nogil=True)
def gradients(image):  # pragma: no cover - compiled
    """Sobel gradients along x and y at every second pixel of every second row, mirrored beyond."""
    height, width = image.shape
    x = np.empty(((height + 1) // 2, (width + 1) // 2), np.float32)
    y = np.empty_like(x)
    for row in range(x.shape[0]):
        above, here, below = abs(2 * row - 1), 2 * row, min(2 * row + 1, 2 * height - 2 * row - 3)
        for column in range(x.shape[1]):
            left, right = abs(2 * column - 1), min(2 * column + 1, 2 * width - 2 * column - 3)
            a, b = np.int64(image[above, left]), np.int64(image[above, right])
            c, d = np.int64(image[below, left]), np.int64(image[below, right])
            up, down = np.int64(image[above, 2 * column]), np.int64(image[below, 2 * column])
            across = np.int64(image[here, right]) - np.int64(image[here, left])
            x[row, column] = b - a + 2 * across + d - c
            y[row, column] = c - a + 2 * (down - up) + d - b
    return x, y


@numba.njit(cache=True, nogil=True)
def _on_edges(strength, fine, coarse, least):  # pragma: no cover - compiled
    """Coarse gradients (x, y) on the crests of edges, and the ratios of fine to coarse, [E] each.

    `strength` [H, W] is the squared coarse gradient, `least` that of an edge.
    """
    height, width = strength.shape
    x = np.empty(strength.size, np.float32)
    y = np.empty(strength.size, np.float32)
    ratios = np.empty(strength.size, np.float32)
    count = 0
    for v in range(height):
        for u in range(width):
            here = strength[v, u]
            if here < least:
                continue
            crest = here
            for vv in range(max(v - 1, 0), min(v + 2, height)):
                for uu in range(max(u - 1, 0), min(u + 2, width)):
                    crest = max(crest, strength[vv, uu])
            if here < np.float32(_CREST) * crest:
                continue
            fx, fy = fine[0][v, u], fine[1][v, u]
            x[count], y[count] = coarse[0][v, u], coarse[1][v, u]
            ratios[count] = np.sqrt((fx * fx + fy * fy) / here)
            count += 1
    return x[:count], y[:count], ratios[:count]


def _width_px(ratios: NDArray[np.float32]) -> float:
    """Width of a direction's sharper edges, from the ratios of fine to coarse gradients."""
    if len(ratios) < _MIN_EDGE_PIXELS:
        return 0.0
    # An edge of width s has the gradient 1 / sqrt(s^2 + sigma^2) under a Gaussian of sigma.
    squared = float(np.quantile(ratios, _SHARPEST)) ** 2
    width2 = (_COARSE_PX**2 - squared * _FINE_PX**2) / max(squared - 1.0, 1e-3)
    return min(float(np.sqrt(max(width2, 0.0))), _MAX_WIDTH_PX)
