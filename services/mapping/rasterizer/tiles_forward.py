"""Forward blending: tile lists to colour, depth and alpha (Kerbl et al. 2023, Eq. 3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.mapping.rasterizer.binning import sort_keys
from services.mapping.rasterizer.kernel_types import BLUE, DEPTH, E2, GREEN, RECORD, RED
from services.mapping.rasterizer.lanes import any_lane
from services.mapping.rasterizer.memory import element, fetch_add, load, store
from services.mapping.rasterizer.simd import inlined, kernel, negative_magnitude, select, splat
from services.mapping.rasterizer.tiles import (
    BATCH,
    ONE,
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

# Planes of a tile: red, green, blue, depth, then transmittance. The sign of the transmittance
# says that the pixel has stopped; the pixels outside the image have none.
_LIGHT = 4 * PLANE


class Images(NamedTuple):
    """The rendered images as flat arrays."""

    colour: NDArray[np.float32]  # [H * W * 3]
    depth: NDArray[np.float32]  # [H * W]
    alpha: NDArray[np.float32]  # [H * W]


@kernel
def blend_tiles(tiles, images, counter):
    """Sort and blend one tile per count, front to back."""
    records, lists, camera = tiles
    planes, batch = np.empty(5 * PLANE, np.float32), np.empty(BATCH * RECORD, np.float32)
    spare = np.empty(_longest(lists.tile_starts), np.uint64)
    histograms = np.empty((4, 256), np.int32)
    while True:
        index = fetch_add(counter, 0, 1)
        if index >= len(lists.tile_ends):
            return
        tile = tile_at(index, camera)
        first, stop = np.int64(lists.tile_starts[index]), np.int64(lists.tile_starts[index + 1])
        sort_keys(lists.keys[first:stop], spare, histograms)
        _write_order(lists, first, stop)
        _open_planes(planes, tile)
        while first < stop and _has_light(planes, tile):
            count = min(BATCH, stop - first)
            load_batch(records, lists.gaussians, first, count, batch)
            for k in range(count):
                _paint(planes, batch, k * RECORD, tile)
            first += count
        lists.tile_ends[index] = first
        _write_pixels(planes, tile, camera.width, images)


@inlined
def _longest(starts):
    longest = 1
    for i in range(len(starts) - 1):
        longest = max(longest, starts[i + 1] - starts[i])
    return longest


@inlined
def _write_order(lists, first, stop):
    """Gaussians in order of depth, and for each pair the place it came to."""
    for place in range(first, stop):
        before = first + np.int64(lists.keys[place] & np.uint64(0xFFFFFFFF))
        lists.gaussians[place] = lists.unsorted[before]
        lists.ranks[before] = place


@inlined
def _open_planes(planes, tile):
    planes[:] = ZERO
    for y in range(tile.height):
        for x in range(tile.width):
            planes[_LIGHT + y * STRIDE + x] = ONE


@inlined
def _has_light(planes, tile):
    """Whether any pixel still lets light through."""
    for y in range(tile.height):
        for x in range(0, tile.width, 8):
            if any_lane(load(planes, _LIGHT + y * STRIDE + x) > ZERO):
                return True
    return False


@inlined
def _paint(planes, batch, r, tile):
    """Blend one Gaussian into a tile."""
    box = footprint(batch, r, tile)
    left, right, top, bottom = box
    if top > bottom:
        return
    for x in range(left, right + 1, 8):
        _paint_strip(planes, batch, r, strip_at(batch, r, tile, box, x))


@inlined
def _paint_strip(planes, batch, r, strip):
    red, green = splat(element(batch, r + RED)), splat(element(batch, r + GREEN))
    blue, depth = splat(element(batch, r + BLUE)), splat(element(batch, r + DEPTH))
    e2_per_row = splat(element(batch, r + E2))
    place, dy = strip.place, strip.dy
    for _ in range(strip.rows):
        _, alpha = falloff(strip, strip.tilt + e2_per_row * dy)
        light = load(planes, _LIGHT + place)
        weight = alpha * light
        rest = light - weight
        goes_on = rest > STOP
        weight = select(goes_on, weight, ZERO)
        store(planes, _LIGHT + place, select(goes_on, rest, negative_magnitude(light)))
        _add(planes, place, weight * red)
        _add(planes, PLANE + place, weight * green)
        _add(planes, 2 * PLANE + place, weight * blue)
        _add(planes, 3 * PLANE + place, weight * depth)
        dy += ONE
        place += STRIDE


@inlined
def _add(planes, place, amount):
    store(planes, place, load(planes, place) + amount)


@inlined
def _write_pixels(planes, tile, width, images):
    for y in range(tile.height):
        pixel, p = (tile.top + y) * width + tile.left, y * STRIDE
        for x in range(tile.width):
            for channel in range(3):
                images.colour[(pixel + x) * 3 + channel] = planes[channel * PLANE + p + x]
            images.depth[pixel + x] = planes[3 * PLANE + p + x]
            images.alpha[pixel + x] = ONE - abs(planes[_LIGHT + p + x])
