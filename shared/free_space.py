"""Space that a camera looked through, from the surface that it saw: whatever stands there moved.

Directions are cells of x/z and y/z, so that a cloud without its image will do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

_CELL = 0.03  # of x/z and y/z: 16 pixels at 640x480, more than the gaps between a cloud's points
_REACH = 1.5  # of x/z and y/z: 113 degrees
_MARGIN_M = 0.1
_MARGIN = 0.05  # of the depth, on top: far surfaces are noisy and less well placed


@dataclass(frozen=True)
class FreeSpace:
    """Depth up to which a camera looked through, by cells of its directions."""

    nearest_m: NDArray[np.float64]  # [N, N], of the surface in and around each; infinite: unknown

    def verdicts(
        self, points: NDArray[np.float32], T_view_points: NDArray[np.float64]
    ) -> NDArray[np.int8]:
        """Of points [N, 3]: 1 in free space, -1 at or behind a surface, 0 unknown, [N]."""
        return _verdicts(points, T_view_points, self.nearest_m)


def seen_through(points: NDArray[np.float32], T_view_points: NDArray[np.float64]) -> FreeSpace:
    """The free space before a surface.

    Args:
        points: of the surface, [N, 3].
        T_view_points: brings them to the camera that sees them, [4, 4].
    """
    return FreeSpace(_nearest_m(points, T_view_points))


@numba.njit(cache=True, nogil=True, inline="always")
def _cell(p, T):  # pragma: no cover - compiled
    """Row and column of a point's direction, and its depth; row -1: out of view."""
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    if z < 0.1:
        return -1, -1, z
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    if abs(x) >= _REACH * z or abs(y) >= _REACH * z:
        return -1, -1, z
    return int((y / z + _REACH) / _CELL), int((x / z + _REACH) / _CELL), z


@numba.njit(cache=True, nogil=True)
def _nearest_m(points, T):  # pragma: no cover - compiled
    """The nearest point in and around each cell."""
    side = int(2.0 * _REACH / _CELL) + 1
    nearest = np.full((side, side), np.inf)
    for n in range(len(points)):
        row, column, z = _cell(points[n], T)
        if row >= 0:
            nearest[row, column] = min(nearest[row, column], z)
    around = np.empty((side, side))
    for row in range(side):
        for column in range(side):
            least = np.inf
            for r in range(max(row - 1, 0), min(row + 2, side)):
                for c in range(max(column - 1, 0), min(column + 2, side)):
                    least = min(least, nearest[r, c])
            around[row, column] = least
    return around


@numba.njit(cache=True, nogil=True)
def _verdicts(points, T, nearest):  # pragma: no cover - compiled
    verdicts = np.zeros(len(points), np.int8)
    for n in range(len(points)):
        row, column, z = _cell(points[n], T)
        if row >= 0 and nearest[row, column] < np.inf:
            is_free = nearest[row, column] > (1.0 + _MARGIN) * z + _MARGIN_M
            verdicts[n] = 1 if is_free else -1
    return verdicts
