"""Value noise: the raw material of every procedural texture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[np.float32]


def value_noise(
    rng: np.random.Generator, shape: tuple[int, int], cell: tuple[float, float]
) -> Image:
    """Smooth noise of standard deviation about 1, [H, W]; `cell` is its (row, column) period."""
    rows, columns = (
        max(int(side / period) + 3, 4) for side, period in zip(shape, cell, strict=True)
    )
    coarse = rng.standard_normal((rows, columns)).astype(np.float32)
    height, width = int(rows * cell[0]) + 1, int(columns * cell[1]) + 1
    fine = cv2.resize(
        coarse, (max(width, shape[1]), max(height, shape[0])), interpolation=cv2.INTER_CUBIC
    )
    return np.ascontiguousarray(fine[: shape[0], : shape[1]], np.float32)


def fractal_noise(
    rng: np.random.Generator, shape: tuple[int, int], cell: float, octaves: int, gain: float = 0.6
) -> Image:
    """A sum of value noises, each of half the period and `gain` times the strength."""
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        period = max(cell / 2**octave, 1.0)
        total += gain**octave * value_noise(rng, shape, (period, period))
    return total


def tinted(colour: ArrayLike, brightness: NDArray[np.floating]) -> NDArray[np.uint8]:
    """A colour [3] (or an image [H, W, 3]) times a brightness image around 1, as uint8 RGB."""
    image = np.asarray(colour, np.float32) * brightness[..., None]
    return np.clip(image, 0, 255).astype(np.uint8)
