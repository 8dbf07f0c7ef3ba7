"""Backward blending: image gradients to one gradient record per (Gaussian, tile) pair.

It runs front to back like the forward pass and recomputes alpha. Per pixel it keeps the
transmittance and the remainder r = g . (light from behind), which starts as g . output. With
q = g . (colour, depth, 1) a Gaussian of weight w = alpha T takes w q from the remainder, and
alpha dL/dalpha = w q - r alpha / (1 - alpha).
"""

from __future__ import annotations

import numpy as np

from services.mapping.rasterizer.kernel_types import BLUE, DEPTH, E2, GREEN, RECORD, RED
from services.mapping.rasterizer.lanes import lane_sums, lane_sums_of_two
from services.mapping.rasterizer.memory import element, fetch_add, load, store
from services.mapping.rasterizer.simd import inlined, kernel, select, splat
from services.mapping.rasterizer.tiles import (
    BATCH,
    ONE,
    OPAQUE,
    PLANE,
    STOP,
    STRIDE,
    ZERO,
    falloff,
    footprint,
    load_batch,
    strip_at,
    tile_at,
)

# Planes of a tile: transmittance, remainder, then the gradients of red, green, blue, depth, alpha.
_REST, _GRADIENT = PLANE, 2 * PLANE


@kernel
def blend_tiles_backward(tiles, images, gradients, sums, counter):
    """Fill `sums`, RECORD numbers per pair, one tile per count.

    `images` and `gradients` are the `Images` of the forward pass and the gradients at them.
    """
    records, lists, camera = tiles
    planes, batch = np.empty(7 * PLANE, np.float32), np.empty(BATCH * RECORD, np.float32)
    while True:
        index = fetch_add(counter, 0, 1)
        if index >= len(lists.tile_ends):
            return
        tile = tile_at(index, camera)
        _open_planes(planes, tile, camera.width, images, gradients)
        first, stop = np.int64(lists.tile_starts[index]), np.int64(lists.tile_ends[index])
        sums[stop * RECORD : np.int64(lists.tile_starts[index + 1]) * RECORD] = ZERO
        while first < stop:
            count = min(BATCH, stop - first)
            load_batch(records, lists.gaussians, first, count, batch)
            for k in range(count):
                _sum_pair(planes, batch, k * RECORD, tile, (sums, (first + k) * RECORD))
            first += count


@inlined
def _open_planes(planes, tile, width, images, gradients):
    planes[:] = ZERO
    for y in range(tile.height):
        pixel, p = (tile.top + y) * width + tile.left, y * STRIDE
        for x in range(tile.width):
            planes[p + x] = ONE
            planes[_REST + p + x] = _open_pixel(planes, p + x, pixel + x, images, gradients)


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
def _sum_pair(planes, batch, r, tile, target):
    """Gradient record of one Gaussian in a tile."""
    box = footprint(batch, r, tile)
    left, right, top, bottom = box
    zero = splat(ZERO)
    total = (zero, zero, zero, zero, zero, zero, zero, zero, zero, zero)
    if top <= bottom:
        for x in range(left, right + 1, 8):
            total = _sum_strip(planes, batch, r, strip_at(batch, r, tile, box, x), total)
    sums, place = target
    red, green, blue, depth, v, v1, v2, v11, v12, v22 = total
    store(sums, place, lane_sums(red, green, blue, depth, v, v1, v2, v11))
    store(sums, place + 8, lane_sums_of_two(v12, v22))


@inlined
def _sum_strip(planes, batch, r, strip, total):
    """Add the pixels of a strip to the ten sums, lane by lane."""
    red, green = splat(element(batch, r + RED)), splat(element(batch, r + GREEN))
    blue, depth = splat(element(batch, r + BLUE)), splat(element(batch, r + DEPTH))
    e2_per_row = splat(element(batch, r + E2))
    to_red, to_green, to_blue, to_depth, all_v, all_v1, all_v2, all_v11, all_v12, all_v22 = total
    place, dy = strip.place, strip.dy
    sum_v = splat(ZERO)
    sum_v2, sum_v22 = sum_v, sum_v
    for _ in range(strip.rows):
        e2 = strip.tilt + e2_per_row * dy
        value, alpha = falloff(strip, e2)
        light = load(planes, place)
        weight = alpha * light
        behind = light - weight
        goes_on = behind > STOP
        weight = select(goes_on, weight, ZERO)
        store(planes, place, select(goes_on, behind, ZERO))
        g_red, g_green = load(planes, _GRADIENT + place), load(planes, _GRADIENT + PLANE + place)
        g_blue = load(planes, _GRADIENT + 2 * PLANE + place)
        g_depth = load(planes, _GRADIENT + 3 * PLANE + place)
        q = load(planes, _GRADIENT + 4 * PLANE + place) + g_red * red + g_green * green
        q = q + g_blue * blue + g_depth * depth
        rest = load(planes, _REST + place) - weight * q
        store(planes, _REST + place, rest)
        to_red, to_green = to_red + weight * g_red, to_green + weight * g_green
        to_blue, to_depth = to_blue + weight * g_blue, to_depth + weight * g_depth
        # Where alpha is cut off, it no longer depends on the Gaussian's shape or opacity.
        responds = goes_on & (value < OPAQUE)
        v = select(responds, weight * q - alpha * rest / (ONE - alpha), ZERO)
        sum_v, sum_v2, sum_v22 = sum_v + v, sum_v2 + v * e2, sum_v22 + v * e2 * e2
        dy += ONE
        place += STRIDE
    v1 = strip.e1 * sum_v
    moments = all_v + sum_v, all_v1 + v1, all_v2 + sum_v2
    seconds = all_v11 + strip.e1 * v1, all_v12 + strip.e1 * sum_v2, all_v22 + sum_v22
    return (to_red, to_green, to_blue, to_depth, *moments, *seconds)
