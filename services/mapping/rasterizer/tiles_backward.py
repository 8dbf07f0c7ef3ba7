"""Backward blending: image gradients to one gradient record per (Gaussian, tile) pair.

It runs front to back like the forward pass and recomputes alpha. Per pixel it keeps the
transmittance and the remainder r = g . (light from behind), which starts as g . output. With
q = g . (colour, depth, 1) a Gaussian of weight w = alpha T takes w q from the remainder, and
alpha dL/dalpha = w q - r alpha / (1 - alpha).
"""

from __future__ import annotations

import numpy as np

from services.mapping.rasterizer.kernel_types import BLUE, DEPTH, E2, GREEN, RECORD, RED
from services.mapping.rasterizer.memory import (
    element,
    fetch_add,
    load,
    prefetch_to_write,
    store,
)
from services.mapping.rasterizer.shuffles import load_three, store_lane_sums
from services.mapping.rasterizer.simd import LANES, STRIP_ROWS, inlined, kernel, select, splat
from services.mapping.rasterizer.tiles import (
    BATCH,
    ONE,
    OPAQUE,
    PLANE,
    STOP,
    STRIDE,
    ZERO,
    cut_strips,
    empty_strips,
    falloff,
    load_rows,
    slot_of,
    store_rows,
    strip_at,
    tile_at,
)

# Planes of a tile: transmittance, remainder, then the gradients of red, green, blue, depth, alpha.
_REST, _GRADIENT = PLANE, 2 * PLANE
_GREEN, _BLUE, _DEPTH, _ALPHA = (_GRADIENT + channel * PLANE for channel in range(1, 5))
_ROWS_DOWN = np.float32(STRIP_ROWS)


@kernel
def blend_tiles_backward(tiles, images, gradients, sums, counter):
    """Fill `sums`, RECORD numbers per slot, one tile per count.

    `images` and `gradients` are the `Images` of the forward pass and the gradients at them.
    """
    _, lists, camera = tiles
    planes, strips = np.empty(7 * PLANE, np.float32), empty_strips()
    spare = np.empty(RECORD, np.float32)
    while True:
        index = fetch_add(counter, 0, 1)
        if index >= len(lists.tile_ends):
            return
        tile = tile_at(lists.first_tile + index, camera)
        _open_planes(planes, tile, camera.width, images, gradients)
        first, stop = np.int64(lists.tile_starts[index]), np.int64(lists.tile_ends[index])
        _sum_tile(tiles, tile, (first, stop), (planes, strips, spare), sums)
        _clear_sums(lists, stop, np.int64(lists.tile_starts[index + 1]), sums)


@inlined
def _sum_tile(tiles, tile, span, room, sums):
    """Write the sums of the pairs of a tile."""
    records, lists, _ = tiles
    planes, strips, spare = room
    first, stop = span
    while first < stop:
        last = min(first + BATCH, stop)
        _expect_sums(lists, first, last, sums)
        for s in range(cut_strips(tiles, tile, (first, last, stop), strips)):
            _write_sums(sums, element(strips.slots, s), _sum(planes, records, strips, s), spare)
        first = last


@inlined
def _expect_sums(lists, first, last, sums):
    """The slots of a tile's pairs lie far apart: ask for their cache lines early."""
    for place in range(first, last):
        prefetch_to_write(sums, slot_of(element(lists.keys, place)) * RECORD)


@inlined
def _write_sums(sums, slot, total, spare):
    """The sums of a pair's first strip, or add those of a further one."""
    if slot >= 0:
        store_lane_sums(sums, np.int64(slot) * RECORD, total)
        return
    store_lane_sums(spare, 0, total)
    place = (-1 - np.int64(slot)) * RECORD
    for k in range(0, RECORD, LANES):
        store(sums, place + k, load(sums, place + k) + load(spare, k))


@inlined
def _clear_sums(lists, first, stop, sums):
    """No gradient reaches the Gaussians behind a full tile."""
    for place in range(first, stop):
        record = slot_of(lists.keys[place]) * RECORD
        sums[record : record + RECORD] = ZERO


@inlined
def _open_planes(planes, tile, width, images, gradients):
    planes[:] = ZERO
    whole = tile.width // LANES * LANES
    for y in range(tile.height):
        pixel, p = (tile.top + y) * width + tile.left, y * STRIDE
        planes[p : p + tile.width] = ONE
        for x in range(0, whole, LANES):
            store(planes, _REST + p + x, _open_pixels(planes, p + x, pixel + x, images, gradients))
        for x in range(whole, tile.width):
            planes[_REST + p + x] = _open_pixel(planes, p + x, pixel + x, images, gradients)


@inlined
def _open_pixels(planes, place, pixel, images, gradients):
    """Copy the gradients of LANES pixels to the planes; gives the remainders, g . output."""
    red, green, blue = load_three(images.colour, pixel * 3)
    to_red, to_green, to_blue = load_three(gradients.colour, pixel * 3)
    to_depth, to_alpha = load(gradients.depth, pixel), load(gradients.alpha, pixel)
    store(planes, _GRADIENT + place, to_red)
    store(planes, _GRADIENT + PLANE + place, to_green)
    store(planes, _GRADIENT + 2 * PLANE + place, to_blue)
    store(planes, _GRADIENT + 3 * PLANE + place, to_depth)
    store(planes, _GRADIENT + 4 * PLANE + place, to_alpha)
    rest = to_depth * load(images.depth, pixel) + to_alpha * load(images.alpha, pixel)
    return rest + to_red * red + to_green * green + to_blue * blue


@inlined
def _open_pixel(planes, place, pixel, images, gradients):
    """Copy a pixel's gradients to the planes; gives its first remainder, g . output."""
    to_depth, to_alpha = gradients.depth[pixel], gradients.alpha[pixel]
    planes[_GRADIENT + 3 * PLANE + place] = to_depth
    planes[_GRADIENT + 4 * PLANE + place] = to_alpha
    rest = to_depth * images.depth[pixel] + to_alpha * images.alpha[pixel]
    for channel in range(3):
        to_colour = gradients.colour[pixel * 3 + channel]
        planes[_GRADIENT + channel * PLANE + place] = to_colour
        rest += to_colour * images.colour[pixel * 3 + channel]
    return rest


@inlined
def _sum(planes, records, strips, s):
    """The ten sums over the pixels of a strip, lane by lane."""
    strip, r = strip_at(records, strips, s), np.int64(element(strips.records, s))
    red, green = splat(element(records, r + RED)), splat(element(records, r + GREEN))
    blue, depth = splat(element(records, r + BLUE)), splat(element(records, r + DEPTH))
    e2_per_row, place, dy = splat(element(records, r + E2)), strip.place, strip.dy
    zero = splat(ZERO)
    to_red, to_green, to_blue, to_depth = zero, zero, zero, zero
    sum_v, sum_v2, sum_v22 = zero, zero, zero
    for _ in range(strip.steps):
        e2 = strip.tilt + e2_per_row * dy
        value, alpha = falloff(strip, e2)
        light = load_rows(planes, place)
        weight = alpha * light
        behind = light - weight
        goes_on = behind > STOP
        weight = select(goes_on, weight, ZERO)
        store_rows(planes, place, select(goes_on, behind, ZERO))
        g_red, g_green = load_rows(planes, _GRADIENT + place), load_rows(planes, _GREEN + place)
        g_blue, g_depth = load_rows(planes, _BLUE + place), load_rows(planes, _DEPTH + place)
        q = load_rows(planes, _ALPHA + place) + g_red * red + g_green * green
        q = q + g_blue * blue + g_depth * depth
        rest = load_rows(planes, _REST + place) - weight * q
        store_rows(planes, _REST + place, rest)
        to_red, to_green = to_red + weight * g_red, to_green + weight * g_green
        to_blue, to_depth = to_blue + weight * g_blue, to_depth + weight * g_depth
        # Where alpha is cut off, it no longer depends on the Gaussian's shape or opacity.
        responds = goes_on & (value < OPAQUE)
        v = select(responds, weight * q - alpha * rest / (ONE - alpha), ZERO)
        sum_v, sum_v2, sum_v22 = sum_v + v, sum_v2 + v * e2, sum_v22 + v * e2 * e2
        dy = dy + _ROWS_DOWN
        place += STRIP_ROWS * STRIDE
    v1 = strip.e1 * sum_v
    moments = sum_v, v1, sum_v2, strip.e1 * v1, strip.e1 * sum_v2, sum_v22
    return (to_red, to_green, to_blue, to_depth, *moments)
