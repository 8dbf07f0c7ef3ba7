"""Forward blending: tile lists to colour, depth and alpha (Kerbl et al. 2023, Eq. 3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.mapping.rasterizer.binning import sort_keys
from services.mapping.rasterizer.kernel_types import BLUE, DEPTH, E2, GREEN, RED
from services.mapping.rasterizer.lanes import any_lane
from services.mapping.rasterizer.memory import element, fetch_add, load, store
from services.mapping.rasterizer.shuffles import store_three
from services.mapping.rasterizer.simd import (
    LANES,
    STRIP_ROWS,
    inlined,
    kernel,
    magnitude,
    negative_magnitude,
    select,
    splat,
)
from services.mapping.rasterizer.tiles import (
    BATCH,
    ONE,
    PLANE,
    STOP,
    STRIDE,
    ZERO,
    cut_strips,
    empty_strips,
    falloff,
    load_rows,
    store_rows,
    strip_at,
    tile_at,
)

# Planes of a tile: red, green, blue, depth, then transmittance. The sign of the transmittance
# says that the pixel has stopped; the pixels outside the image have none.
_LIGHT = 4 * PLANE
_ROWS_DOWN = np.float32(STRIP_ROWS)


class Images(NamedTuple):
    """The rendered images as flat arrays."""

    colour: NDArray[np.float32]  # [H * W * 3]
    depth: NDArray[np.float32]  # [H * W]
    alpha: NDArray[np.float32]  # [H * W]


@kernel
def blend_tiles(tiles, images, counter):
    """Sort and blend one tile per count, front to back."""
    _, lists, camera = tiles
    planes, strips = np.empty(5 * PLANE, np.float32), empty_strips()
    spare = np.empty(_longest(lists.tile_starts), np.uint64)
    histograms = np.empty((4, 256), np.int32)
    while True:
        index = fetch_add(counter, 0, 1)
        if index >= len(lists.tile_ends):
            return
        tile = tile_at(lists.first_tile + index, camera)
        first, stop = np.int64(lists.tile_starts[index]), np.int64(lists.tile_starts[index + 1])
        sort_keys(lists.keys[first:stop], spare, histograms)
        lists.tile_ends[index] = _blend(tiles, tile, (first, stop), planes, strips)
        _write_pixels(planes, tile, camera.width, images)


@inlined
def _blend(tiles, tile, span, planes, strips):
    """Blend a tile's list into its planes; gives where it stopped because the tile was full."""
    first, stop = span
    _open_planes(planes, tile)
    while first < stop and _has_light(planes, tile):
        last = min(first + BATCH, stop)
        for s in range(cut_strips(tiles, tile, (first, last, stop), strips)):
            _paint(planes, tiles.records, strips, s)
        first = last
    return first


@inlined
def _longest(starts):
    longest = 1
    for i in range(len(starts) - 1):
        longest = max(longest, starts[i + 1] - starts[i])
    return longest


@inlined
def _open_planes(planes, tile):
    planes[:] = ZERO
    for y in range(tile.height):
        row = _LIGHT + y * STRIDE
        planes[row : row + tile.width] = ONE


@inlined
def _has_light(planes, tile):
    """Whether any pixel still lets light through."""
    for y in range(tile.height):
        for x in range(0, tile.width, LANES):
            if any_lane(load(planes, _LIGHT + y * STRIDE + x) > ZERO):
                return True
    return False


@inlined
def _paint(planes, records, strips, s):
    """Blend one strip into a tile."""
    strip, r = strip_at(records, strips, s), np.int64(element(strips.records, s))
    red, green = splat(element(records, r + RED)), splat(element(records, r + GREEN))
    blue, depth = splat(element(records, r + BLUE)), splat(element(records, r + DEPTH))
    e2_per_row = splat(element(records, r + E2))
    place, dy = strip.place, strip.dy
    for _ in range(strip.steps):
        _, alpha = falloff(strip, strip.tilt + e2_per_row * dy)
        light = load_rows(planes, _LIGHT + place)
        weight = alpha * light
        rest = light - weight
        goes_on = rest > STOP
        weight = select(goes_on, weight, ZERO)
        store_rows(planes, _LIGHT + place, select(goes_on, rest, negative_magnitude(light)))
        _add(planes, place, weight * red)
        _add(planes, PLANE + place, weight * green)
        _add(planes, 2 * PLANE + place, weight * blue)
        _add(planes, 3 * PLANE + place, weight * depth)
        dy = dy + _ROWS_DOWN
        place += STRIP_ROWS * STRIDE


@inlined
def _add(planes, place, amount):
    store_rows(planes, place, load_rows(planes, place) + amount)


@inlined
def _write_pixels(planes, tile, width, images):
    whole = tile.width // LANES * LANES
    for y in range(tile.height):
        pixel, p = (tile.top + y) * width + tile.left, y * STRIDE
        for x in range(0, whole, LANES):
            red, green = load(planes, p + x), load(planes, PLANE + p + x)
            colour = red, green, load(planes, 2 * PLANE + p + x)
            store_three(images.colour, (pixel + x) * 3, colour)
            store(images.depth, pixel + x, load(planes, 3 * PLANE + p + x))
            store(images.alpha, pixel + x, ONE - magnitude(load(planes, _LIGHT + p + x)))
        for x in range(whole, tile.width):
            for channel in range(3):
                images.colour[(pixel + x) * 3 + channel] = planes[channel * PLANE + p + x]
            images.depth[pixel + x] = planes[3 * PLANE + p + x]
            images.alpha[pixel + x] = ONE - abs(planes[_LIGHT + p + x])
