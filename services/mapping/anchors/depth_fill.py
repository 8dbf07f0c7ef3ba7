"""Depth for pixels that the sensor left out, from the readings around them (pull-push)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def filled_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image with every hole filled by averages of ever coarser cells, [H, W], metres.

    Measured pixels keep their value; an image without any reading stays empty. Good enough to
    seed anchors that the colours of several keyframes then put right, never a measurement.
    """
    is_known = depth_m > 0
    if is_known.all() or not is_known.any():
        return depth_m
    height, width = depth_m.shape
    coarse = filled_depth(_halved(depth_m))
    spread = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(is_known, depth_m, spread)


def _halved(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of the known pixels of 2x2 cells; 0 where a cell has none."""
    height, width = depth_m.shape
    padded = np.pad(depth_m, ((0, height % 2), (0, width % 2)))
    cells = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
    counts = (cells > 0).sum(axis=(1, 3))
    return (cells.sum(axis=(1, 3)) / np.maximum(counts, 1)).astype(np.float32)
