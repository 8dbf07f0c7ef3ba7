"""A depth image as connected surfaces: what one pixel of a body tells holds for the body."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from services.tracking.point_cloud import BASE_PIXELS


@dataclass(frozen=True)
class Surfaces:
    """Connected surfaces of a depth image, on a grid of every `step_px`-th pixel."""

    labels: NDArray[np.int32]  # [H / step, W / step], 0: an edge, or no depth
    depth_m: NDArray[np.float32]  # [H / step, W / step]
    step_px: int

    @property
    def count(self) -> int:
        """Labels, that of edges among them."""
        return int(self.labels.max(initial=0)) + 1

    def areas(self) -> NDArray[np.float64]:
        """Share of each in all that has depth, [count]; nothing for edges."""
        cells = np.bincount(self.labels.ravel(), minlength=self.count)
        cells[0] = 0
        return cells / max(1, cells.sum())

    def counts(self, pixels: NDArray[np.floating]) -> NDArray[np.int64]:
        """How many of some pixels [M, 2] lie on each surface, [count]; none on edges."""
        rows, columns = self.labels.shape
        cells = np.floor(pixels / self.step_px).astype(np.int64)
        u, v = np.clip(cells[:, 0], 0, columns - 1), np.clip(cells[:, 1], 0, rows - 1)
        counts = np.bincount(self.labels[v, u], minlength=self.count)
        counts[0] = 0
        return counts

    def median_m(self, chosen: NDArray[np.bool_]) -> float:
        """Median depth of the chosen surfaces [count]; infinite where there are none."""
        depths = self.depth_m[chosen[self.labels]]
        return float(np.median(depths)) if len(depths) else np.inf

    def mask(self, chosen: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Pixels of the chosen surfaces [count] with their edges, [H, W]."""
        cells = cv2.dilate(chosen[self.labels].astype(np.uint8), np.ones((5, 5), np.uint8))
        size = (shape[1], shape[0])
        return cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)


def surfaces_of(depth_m: NDArray[np.float32], grid_px: int, max_jump: float) -> Surfaces:
    """Split a depth image [H, W] where it jumps.

    Args:
        depth_m: 0 where there is none.
        grid_px: step of the grid at 640x480.
        max_jump: from one cell of the grid to the next, as a share of the depth.
    """
    step = max(1, round(grid_px * np.sqrt(depth_m.size / BASE_PIXELS)))
    z = np.ascontiguousarray(depth_m[step // 2 :: step, step // 2 :: step])
    is_inside = z > 0.0
    limit = max_jump * z
    is_inside[:, :-1] &= np.abs(np.diff(z, axis=1)) <= limit[:, :-1]
    is_inside[:-1] &= np.abs(np.diff(z, axis=0)) <= limit[:-1]
    _, labels = cv2.connectedComponents(is_inside.astype(np.uint8), connectivity=4)
    return Surfaces(np.asarray(labels, np.int32), z, step)
