"""Binning: which Gaussians touch which tile, listed in order of their index.

Two passes over chunks of Gaussians, a count and a scatter, with prefix sums between. The lists do
not depend on the number of threads because the chunks do not. Each tile sorts its own list.
"""

from __future__ import annotations

import numpy as np

from services.mapping.rasterizer.kernel_types import (
    CHUNK,
    DEPTH,
    E1,
    E2,
    MEAN_X,
    MEAN_Y,
    REACH,
    RECORD,
    SHEAR,
    SLANT,
    TILE,
    Camera,
    Projected,
    TileLists,
)
from services.mapping.rasterizer.memory import fetch_add
from services.mapping.rasterizer.simd import inlined, kernel
from services.mapping.rasterizer.threads import Workers

_HALF, _ZERO = np.float32(0.5), np.float32(0.0)
_TILE_SIDE = np.float32(TILE - 1)  # between the centres of its first and last pixel


def bin_gaussians(projected: Projected, camera: Camera, pool: Workers) -> TileLists:
    """List the Gaussians of every tile; the lists still lack their order by depth."""
    count, tiles = len(projected.counts), camera.tiles()
    chunks = -(-count // CHUNK)
    histograms = np.zeros((chunks, tiles), np.int32)
    totals = np.zeros(chunks, np.int64)
    tile_starts = np.empty(tiles + 1, np.int32)
    pool.run(_count_hits, projected, camera.width, histograms, totals)
    pairs = _prefix_sums(histograms, totals, tile_starts)
    lists = TileLists(
        tile_starts=tile_starts,
        tile_ends=np.empty(tiles, np.int32),
        starts=np.zeros(count + 1, np.int32),
        slots=np.empty(pairs, np.int32),
        unsorted=np.empty(pairs, np.int32),
        keys=np.empty(pairs, np.uint64),
        gaussians=np.empty(pairs, np.int32),
        ranks=np.empty(pairs, np.int32),
    )
    pool.run(_scatter, projected, camera.width, (histograms, totals), lists)
    return lists


@inlined
def _squared_distance(records, r, dx, dy):
    """The exponent / 8 at an offset from the mean."""
    e1 = dx * records[r + E1]
    e2 = (dy - records[r + SHEAR] * dx) * records[r + E2]
    return e1 * e1 + e2 * e2


@inlined
def _hits_tile(records, i, column, row):
    """Whether the ellipse reaches the centre of any pixel of a tile (as a continuous box)."""
    r = i * RECORD
    left = np.float32(column * TILE) + _HALF - records[r + MEAN_X]
    top = np.float32(row * TILE) + _HALF - records[r + MEAN_Y]
    right, bottom = left + _TILE_SIDE, top + _TILE_SIDE
    dx, dy = min(max(_ZERO, left), right), min(max(_ZERO, top), bottom)
    if dx == _ZERO and dy == _ZERO:
        return True
    reach = records[r + REACH]
    # The nearest point of the box lies on an edge that faces the mean.
    if dx != _ZERO:
        y = min(max(records[r + SHEAR] * dx, top), bottom)
        if _squared_distance(records, r, dx, y) <= reach:
            return True
    if dy != _ZERO:
        x = min(max(records[r + SLANT] * dy, left), right)
        return _squared_distance(records, r, x, dy) <= reach
    return False


@inlined
def _box(boxes, i):
    return boxes[i * 4], boxes[i * 4 + 1], boxes[i * 4 + 2], boxes[i * 4 + 3]


@kernel
def _count_hits(projected, width, histograms, totals, counter):
    """Count the tiles that each chunk's Gaussians hit, tile by tile and in all."""
    columns = (width + TILE - 1) // TILE
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, len(projected.counts))
        if start >= stop:
            return
        for i in range(start, stop):
            single = projected.counts[i] == 1
            if projected.counts[i] == 0:
                continue
            left, right, top, bottom = _box(projected.boxes, i)
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    if single or _hits_tile(projected.records, i, column, row):
                        histograms[chunk, row * columns + column] += 1
                        totals[chunk] += 1


@kernel
def _prefix_sums(histograms, totals, tile_starts):
    """Turn counts into first places, in place; gives the number of pairs."""
    place = 0
    for tile in range(histograms.shape[1]):
        tile_starts[tile] = place
        for chunk in range(histograms.shape[0]):
            hits = histograms[chunk, tile]
            histograms[chunk, tile] = place
            place += hits
    tile_starts[histograms.shape[1]] = place
    first = 0
    for chunk in range(len(totals)):
        hits = totals[chunk]
        totals[chunk] = first
        first += hits
    return place


@kernel
def _scatter(projected, width, places, lists, counter):
    """Write every pair to its tile's list, and note for each Gaussian where its pairs went."""
    columns = (width + TILE - 1) // TILE
    histograms, totals = places
    depth_bits = projected.records.view(np.uint32)
    count = len(projected.counts)
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, count)
        if start >= stop:
            return
        slot = totals[chunk]
        for i in range(start, stop):
            lists.starts[i] = slot
            single = projected.counts[i] == 1
            if projected.counts[i] == 0:
                continue
            depth = np.uint64(depth_bits[i * RECORD + DEPTH]) << np.uint64(32)
            left, right, top, bottom = _box(projected.boxes, i)
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    if single or _hits_tile(projected.records, i, column, row):
                        tile = row * columns + column
                        place = histograms[chunk, tile]
                        histograms[chunk, tile] = place + 1
                        lists.unsorted[place] = i
                        lists.keys[place] = depth | np.uint64(place - lists.tile_starts[tile])
                        lists.slots[slot] = place
                        slot += 1
        if stop == count:
            lists.starts[count] = slot


@inlined
def _digit(key, byte):
    """A byte of the depth, which is the upper half of the key."""
    return np.int64((key >> np.uint64(32 + 8 * byte)) & np.uint64(255))


@inlined
def _insertion_sort(keys, first, last):
    for i in range(first + 1, last):
        key, j = keys[i], i - 1
        while j >= first and keys[j] > key:
            keys[j + 1] = keys[j]
            j -= 1
        keys[j + 1] = key


@inlined
def _radix_pass(source, target, histogram, byte):
    """Stable counting sort by one byte; False where all keys share it and nothing moved."""
    if histogram[_digit(source[0], byte)] == len(source):
        return False
    place = 0
    for value in range(256):
        count = histogram[value]
        histogram[value] = place
        place += count
    for i in range(len(source)):
        value = _digit(source[i], byte)
        target[histogram[value]] = source[i]
        histogram[value] += 1
    return True


@inlined
def sort_keys(keys, spare, histograms):
    """Sort by depth, then by place: radix sort over the four bytes of the depth.

    Args:
        keys: sorted in place, [n].
        spare: room for n keys.
        histograms: room for four histograms, [4, 256].
    """
    count = len(keys)
    if count < 48:
        _insertion_sort(keys, 0, count)
        return
    histograms[:] = 0
    for i in range(count):
        for byte in range(4):
            histograms[byte, _digit(keys[i], byte)] += 1
    source, target = keys, spare[:count]
    swapped = False
    for byte in range(4):
        if _radix_pass(source, target, histograms[byte], byte):
            source, target = target, source
            swapped = not swapped
    if swapped:
        keys[:] = source
