"""Depth for pixels that the sensor left out, from the readings around them.

Holes are filled with the smoothest inverse depth: of a plane it is linear in the image, so that a
black door in a wall, or a floor beyond the sensor's range, continues what is measured around it
(Laplace's equation, solved coarse to fine).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_SWEEPS = 8  # of Jacobi's method at each level, from the coarser one's solution
_COARSEST_PX = 4  # sides of an image that gets its mean
_FARTHEST_M = 100.0
_NEIGHBOURS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4


def filled_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image with every hole filled, [H, W], metres.

    Measured pixels keep their value; an image without any reading stays empty. Good enough to
    seed anchors that the colours of several keyframes then put right, never a measurement.
    """
    is_known = depth_m > 0
    if is_known.all() or not is_known.any():
        return depth_m
    inverse = np.where(is_known, 1.0 / np.maximum(depth_m, 1e-3), 0.0).astype(np.float32)
    inverse = _smoothest(inverse, is_known)
    return np.where(is_known, depth_m, 1.0 / np.maximum(inverse, 1.0 / _FARTHEST_M))


def _smoothest(values: NDArray[np.float32], is_known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The values [H, W], where unknown the mean of their neighbours, as far as the sweeps go."""
    height, width = values.shape
    if is_known.all():
        return values
    if min(height, width) <= _COARSEST_PX:
        start = np.full_like(values, values[is_known].mean())
    else:
        coarse = _smoothest(*_halved(values, is_known))
        size = width + width % 2, height + height % 2
        start = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
    filled: NDArray[np.float32] = np.where(is_known, values, start).astype(np.float32)
    for _ in range(_SWEEPS):
        cv2.filter2D(filled, -1, _NEIGHBOURS, dst=filled, borderType=cv2.BORDER_REFLECT_101)
        np.copyto(filled, values, where=is_known)
    return filled


def _halved(
    values: NDArray[np.float32], is_known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Means of the known pixels of 2x2 cells, and which cells have any; unknown ones are 0."""
    odd = 0, values.shape[0] % 2, 0, values.shape[1] % 2
    shares = is_known.astype(np.float32)
    if any(odd):
        values = _padded(values, odd)
        shares = _padded(shares, odd)
    size = values.shape[1] // 2, values.shape[0] // 2
    shares = cv2.resize(shares, size, interpolation=cv2.INTER_AREA)
    means = cv2.resize(values, size, interpolation=cv2.INTER_AREA) / np.maximum(shares, 0.25)
    return means.astype(np.float32), shares > 0.0


def _padded(values: NDArray[np.float32], odd: tuple[int, int, int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.copyMakeBorder(values, *odd, cv2.BORDER_CONSTANT), np.float32)
