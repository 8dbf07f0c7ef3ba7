"""Separable blurs of rows by the window of SSIM: 11 taps of a Gaussian, zeros beyond the border."""

from __future__ import annotations

import numpy as np

from services.mapping.rasterizer.memory import load, store
from services.mapping.rasterizer.simd import LANES, allocating, inlined, splat

_RADIUS = 5
_WINDOW = np.exp(-(np.arange(-_RADIUS, _RADIUS + 1) ** 2) / (2 * 1.5**2))
_TAPS = tuple(np.float32(tap) for tap in _WINDOW / _WINDOW.sum())
_ZERO = np.float32(0.0)


@inlined
def blur_across(row, x):
    """Horizontal blur of LANES columns: 11 symmetric taps around column x."""
    total = load(row, x) * _TAPS[5]
    total = total + (load(row, x - 1) + load(row, x + 1)) * _TAPS[4]
    total = total + (load(row, x - 2) + load(row, x + 2)) * _TAPS[3]
    total = total + (load(row, x - 3) + load(row, x + 3)) * _TAPS[2]
    total = total + (load(row, x - 4) + load(row, x + 4)) * _TAPS[1]
    return total + (load(row, x - 5) + load(row, x + 5)) * _TAPS[0]


@inlined
def _rows_around(place, layout):
    """Where the 11 rows of a vertical blur start; those beyond the border count for nothing."""
    row, y = place
    last, stride = layout.height - 1, layout.stride
    top = row - y * stride
    return (
        top + max(y - 5, 0) * stride,
        top + max(y - 4, 0) * stride,
        top + max(y - 3, 0) * stride,
        top + max(y - 2, 0) * stride,
        top + max(y - 1, 0) * stride,
        row,
        top + min(y + 1, last) * stride,
        top + min(y + 2, last) * stride,
        top + min(y + 3, last) * stride,
        top + min(y + 4, last) * stride,
        top + min(y + 5, last) * stride,
    )


@inlined
def _taps_around(y, last):
    """The weights of these rows."""
    return (
        _TAPS[0] if y - 5 >= 0 else _ZERO,
        _TAPS[1] if y - 4 >= 0 else _ZERO,
        _TAPS[2] if y - 3 >= 0 else _ZERO,
        _TAPS[3] if y - 2 >= 0 else _ZERO,
        _TAPS[4] if y - 1 >= 0 else _ZERO,
        _TAPS[5],
        _TAPS[6] if y + 1 <= last else _ZERO,
        _TAPS[7] if y + 2 <= last else _ZERO,
        _TAPS[8] if y + 3 <= last else _ZERO,
        _TAPS[9] if y + 4 <= last else _ZERO,
        _TAPS[10] if y + 5 <= last else _ZERO,
    )


@allocating
def spare_rows(stride):
    """Three rows for the vertical blurs."""
    return np.zeros(stride, np.float32), np.zeros(stride, np.float32), np.zeros(stride, np.float32)


@inlined
def blur_products_down(a, b, place, layout, rows):
    """Vertical blurs of a row of a, a b, and a a, in the order (a, a a, a b)."""
    down, down_square, down_product = rows
    starts, taps = _rows_around(place, layout), _taps_around(place[1], layout.height - 1)
    for x in range(0, layout.stride, LANES):
        zero = splat(_ZERO)
        sums = zero, zero, zero
        sums = _add_row(sums, a, b, starts[0] + x, taps[0])
        sums = _add_row(sums, a, b, starts[1] + x, taps[1])
        sums = _add_row(sums, a, b, starts[2] + x, taps[2])
        sums = _add_row(sums, a, b, starts[3] + x, taps[3])
        sums = _add_row(sums, a, b, starts[4] + x, taps[4])
        sums = _add_row(sums, a, b, starts[5] + x, taps[5])
        sums = _add_row(sums, a, b, starts[6] + x, taps[6])
        sums = _add_row(sums, a, b, starts[7] + x, taps[7])
        sums = _add_row(sums, a, b, starts[8] + x, taps[8])
        sums = _add_row(sums, a, b, starts[9] + x, taps[9])
        sums = _add_row(sums, a, b, starts[10] + x, taps[10])
        store(down, x, sums[0])
        store(down_square, x, sums[1])
        store(down_product, x, sums[2])


@inlined
def _add_row(sums, a, b, place, tap):
    """Add a row's share to the blurs of (a, a a, a b)."""
    mean, square, product = sums
    value = load(a, place)
    weighted = value * tap
    return mean + weighted, square + weighted * value, product + weighted * load(b, place)


@inlined
def blur_planes_down(planes, place, layout, rows):
    """Vertical blurs of a row of three planes."""
    starts, taps = _rows_around(place, layout), _taps_around(place[1], layout.height - 1)
    for x in range(0, layout.stride, LANES):
        store(rows[0], x, _down(planes[0], starts, taps, x))
        store(rows[1], x, _down(planes[1], starts, taps, x))
        store(rows[2], x, _down(planes[2], starts, taps, x))


@inlined
def _down(plane, starts, taps, x):
    """Vertical blur of LANES columns."""
    total = load(plane, starts[0] + x) * taps[0]
    total = total + load(plane, starts[1] + x) * taps[1]
    total = total + load(plane, starts[2] + x) * taps[2]
    total = total + load(plane, starts[3] + x) * taps[3]
    total = total + load(plane, starts[4] + x) * taps[4]
    total = total + load(plane, starts[5] + x) * taps[5]
    total = total + load(plane, starts[6] + x) * taps[6]
    total = total + load(plane, starts[7] + x) * taps[7]
    total = total + load(plane, starts[8] + x) * taps[8]
    total = total + load(plane, starts[9] + x) * taps[9]
    return total + load(plane, starts[10] + x) * taps[10]
