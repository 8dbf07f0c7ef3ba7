"""Forward projection: world Gaussians to records, tile boxes and counts of hits per tile."""

from __future__ import annotations

import numpy as np

from services.mapping.rasterizer.geometry import (
    load_block,
    project_block,
    shapes_of,
    spare_block,
    whole_block,
)
from services.mapping.rasterizer.kernel_types import CHUNK, CUT, RECORD, TILE
from services.mapping.rasterizer.lanes import all_lanes
from services.mapping.rasterizer.memory import fetch_add, store_indices
from services.mapping.rasterizer.places import round_down, round_up, split_exponent
from services.mapping.rasterizer.scene import NEAR_M
from services.mapping.rasterizer.shuffles import load_four, load_three, store_records
from services.mapping.rasterizer.simd import (
    LANES,
    inlined,
    kernel,
    maximum,
    minimum,
    select,
    splat,
    square_root,
)
from services.mapping.rasterizer.tile_boxes import tile_box, tiles_in_line, tiles_of_row

_NEAR = np.float32(NEAR_M)
_ZERO, _ONE, _HALF, _FOUR = (np.float32(x) for x in (0.0, 1.0, 0.5, 4.0))
_PER_TILE = np.float32(1.0 / TILE)

# ln(1 + f) / f^3 - 1 / f^2 + 1 / (2 f) for f from -0.293 to 0.414, highest power first.
_LOG = tuple(
    np.float32(c)
    for c in (
        7.0376836292e-2,
        -1.1514610310e-1,
        1.1676998740e-1,
        -1.2420140846e-1,
        1.4249322787e-1,
        -1.6668057665e-1,
        2.0000714765e-1,
        -2.4999993993e-1,
        3.3333331174e-1,
    )
)
_LN_2_HIGH, _LN_2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_NEVER = np.float32(-1e4)  # the logarithm of nothing, as good as


@kernel
def project(splats, camera, projected, counter):
    """Fill `projected`, a chunk of Gaussians per count."""
    spare, total = spare_block(), len(splats.opacities)
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, total)
        if start >= stop:
            return
        valid, hits = True, projected.hits[chunk]
        hits[:] = 0
        for base in range(start, stop, LANES):
            source, i = whole_block(splats, spare, base)
            valid &= _project_block(source, i, camera, projected, base)
            for gaussian in range(base, min(base + LANES, stop)):
                _count_hits(projected, gaussian, camera, hits)
        projected.valid[chunk] = valid


@inlined
def _project_block(splats, i, camera, projected, place):
    """Write the records and boxes of LANES Gaussians; gives whether all inputs were finite."""
    block, colour = load_block(splats, i), load_three(splats.colours, i * 3)
    seen = project_block(block, camera)
    a, b, c, e1, e2 = shapes_of(seen.spread)
    x, y = seen.u * camera.fx + camera.cx, seen.v * camera.fy + camera.cy
    log_opacity = _log(block.opacity) * 0.125
    reach = maximum(log_opacity - CUT, splat(_ZERO))
    half_width, half_height = square_root(reach * a) * _FOUR, square_root(reach * c) * _FOUR
    ellipse = (half_width, half_height, reach, b / c)
    numbers = (x, y, e1, b / a, e2, log_opacity, *colour, seen.z, *ellipse, reach, reach)
    store_records(projected.records, place * RECORD, numbers)
    # Written so that NaN fails: a projection may overflow although its inputs were finite.
    visible = (seen.z >= _NEAR) & (log_opacity > CUT)
    columns = x - half_width - _HALF, x + half_width - _HALF
    rows = y - half_height - _HALF, y + half_height - _HALF
    _write_box(projected.boxes, place, camera, (columns, rows), visible)
    return _are_finite(block, splats, i, colour)


@inlined
def _log(x):
    """The natural logarithm, relative error 1e-7; far below zero for zero and less."""
    exponent, mantissa = split_exponent(x)
    f = mantissa - _ONE
    total = f * _LOG[0] + _LOG[1]
    total = total * f + _LOG[2]
    total = total * f + _LOG[3]
    total = total * f + _LOG[4]
    total = total * f + _LOG[5]
    total = total * f + _LOG[6]
    total = total * f + _LOG[7]
    total = total * f + _LOG[8]
    square = f * f
    total = total * f * square + exponent * _LN_2_LOW - square * _HALF + f
    return select(x > _ZERO, total + exponent * _LN_2_HIGH, _NEVER)


@inlined
def _are_finite(block, splats, i, colour):
    """Whether all inputs are; 0 * x is NaN for the others."""
    quat = load_four(splats.quats, i * 4)
    (a, b, c), (d, e, f), (g, h, j, k) = block.mean, block.scale, quat
    l, m, n = colour
    total = a * _ZERO + b * _ZERO + c * _ZERO + d * _ZERO + e * _ZERO + f * _ZERO + g * _ZERO
    total = total + h * _ZERO + j * _ZERO + k * _ZERO + l * _ZERO + m * _ZERO + n * _ZERO
    return all_lanes(total + block.opacity * _ZERO >= _ZERO)


@inlined
def _write_box(boxes, place, camera, ranges, visible):
    """The tiles that a box of pixels touches; none, as first > last, where it is not visible."""
    padded = len(boxes) // 4
    columns, rows = ranges
    left, right = round_up(columns[0]), round_down(columns[1])
    top, bottom = round_up(rows[0]), round_down(rows[1])
    last_x, last_y = np.float32(camera.width - 1), np.float32(camera.height - 1)
    visible = visible & (left <= right) & (top <= bottom) & (right >= _ZERO) & (bottom >= _ZERO)
    visible = visible & (left <= last_x) & (top <= last_y)
    first_column = select(visible, _tile_of(left, last_x), _ONE)
    store_indices(boxes, place, first_column)
    store_indices(boxes, padded + place, select(visible, _tile_of(right, last_x), _ZERO))
    store_indices(boxes, 2 * padded + place, select(visible, _tile_of(top, last_y), _ZERO))
    store_indices(boxes, 3 * padded + place, select(visible, _tile_of(bottom, last_y), _ZERO))


@inlined
def _tile_of(position, last):
    return round_down(minimum(maximum(position, splat(_ZERO)), splat(last)) * _PER_TILE)


@inlined
def _count_hits(projected, i, camera, hits):
    """Count a Gaussian in each tile that it hits."""
    columns = (camera.width + TILE - 1) // TILE
    box = tile_box(projected.boxes, i)
    left, right, top, bottom = box
    if left < right and top < bottom:
        for row in range(top, bottom + 1):
            first, last = tiles_of_row(projected.records, i, row, left, right)
            for column in range(first, last + 1):
                hits[row * columns + column] += 1
        return
    tile, step, count = tiles_in_line(box, columns)
    for _ in range(count):
        hits[tile] += 1
        tile += step
