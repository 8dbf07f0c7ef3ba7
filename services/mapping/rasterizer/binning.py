"""Binning: which Gaussians touch which tile, listed in order of their index.

The projection counted the hits of each chunk of Gaussians in each tile; prefix sums over them
tell every chunk where to write. The lists do not depend on the number of threads because the
chunks do not. Each tile sorts its own list.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from services.mapping.rasterizer.kernel_types import (
    CHUNK,
    DEPTH,
    RECORD,
    TILE,
    Camera,
    Projected,
    TileLists,
)
from services.mapping.rasterizer.memory import fetch_add
from services.mapping.rasterizer.scratch import Scratch
from services.mapping.rasterizer.simd import inlined, kernel
from services.mapping.rasterizer.threads import Workers
from services.mapping.rasterizer.tile_boxes import tile_box, tiles_in_line, tiles_of_row

# Pairs of a Gaussian and a tile that are listed at once: 76 bytes each with their gradients.
MOST_PAIRS = 4_000_000


def tile_ranges(projected: Projected) -> list[range]:
    """Cut the tiles into ranges whose lists fit into memory together: nearly always one."""
    bounds, pairs = [0], 0
    for tile, count in enumerate(projected.hits.sum(axis=0, dtype=np.int64).tolist()):
        if pairs + count > MOST_PAIRS and pairs > 0:
            bounds.append(tile)
            pairs = 0
        pairs += count
    bounds.append(projected.hits.shape[1])
    return [range(first, stop) for first, stop in pairwise(bounds)]


def bin_gaussians(
    projected: Projected, camera: Camera, tiles: range, pool: Workers, scratch: Scratch
) -> TileLists:
    """List the Gaussians of a range of tiles; the lists still lack their order by depth."""
    places = projected.hits[:, tiles.start : tiles.stop].copy()
    tile_starts = np.empty(len(tiles) + 1, np.int32)
    slots = np.empty(len(places), np.int64)
    pairs = _prefix_sums(places, slots, tile_starts)
    lists = TileLists(
        first_tile=tiles.start,
        tile_starts=tile_starts,
        tile_ends=np.empty(len(tiles), np.int32),
        keys=scratch.borrow(pairs, np.uint64),
        starts=scratch.borrow(projected.num_gaussians + 1, np.int32),
        owners=scratch.borrow(pairs, np.int32),
    )
    lists.starts[-1] = pairs
    pool.run(_scatter, projected, camera.width, (places, slots), lists)
    return lists


@kernel
def _prefix_sums(places, slots, tile_starts):
    """Turn counts into first places, in place, and find each chunk's first slot.

    Gives the number of pairs.
    """
    chunks, tiles = places.shape
    slots[:] = 0
    place = 0
    for tile in range(tiles):
        tile_starts[tile] = place
        for chunk in range(chunks):
            count = places[chunk, tile]
            places[chunk, tile] = place
            place += count
            slots[chunk] += count
    tile_starts[tiles] = place
    first = 0
    for chunk in range(chunks):
        count = slots[chunk]
        slots[chunk] = first
        first += count
    return place


@kernel
def _scatter(projected, width, start_of, lists, counter):
    """Write every pair to its tile's list, and each Gaussian's slots, a chunk per count."""
    columns, total = (width + TILE - 1) // TILE, projected.num_gaussians
    all_places, slots = start_of
    depth_bits = projected.records.view(np.uint32)
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, total)
        if start >= stop:
            return
        slot, places = slots[chunk], all_places[chunk]
        for i in range(start, stop):
            lists.starts[i] = slot
            depth = np.uint64(depth_bits[i * RECORD + DEPTH]) << np.uint64(32)
            slot = _scatter_one(projected, (i, depth), columns, (places, lists), slot)


@inlined
def _scatter_one(projected, gaussian, columns, target, slot):
    """Write the pairs of a Gaussian; gives the next free slot."""
    i, _ = gaussian
    box = tile_box(projected.boxes, i)
    left, right, top, bottom = box
    if left < right and top < bottom:
        for row in range(top, bottom + 1):
            first, last = tiles_of_row(projected.records, i, row, left, right)
            for tile in range(row * columns + first, row * columns + last + 1):
                slot = _write_pair(gaussian, tile, target, slot)
        return slot
    tile, step, count = tiles_in_line(box, columns)
    for _ in range(count):
        slot = _write_pair(gaussian, tile, target, slot)
        tile += step
    return slot


@inlined
def _write_pair(gaussian, tile, target, slot):
    """Write a pair, if its tile lies in the range that is listed; gives the next free slot."""
    places, lists = target
    k = tile - lists.first_tile
    if k < 0 or k >= len(places):
        return slot
    i, depth = gaussian
    place = places[k]
    places[k] = place + 1
    lists.keys[place] = depth | np.uint64(slot)
    lists.owners[slot] = i
    return slot + 1


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
        for i in range(count):
            keys[i] = spare[i]
