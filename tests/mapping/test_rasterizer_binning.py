"""Tile lists: every pair that matters, in order of depth."""

import numpy as np
import pytest
import torch

from services.mapping.rasterizer import CpuRasterizer, Gaussians, View, binning
from services.mapping.rasterizer.binning import bin_gaussians, sort_keys
from services.mapping.rasterizer.kernel_types import (
    REACH,
    RECORD,
    TILE,
    Camera,
    Projected,
    Splats,
    TileLists,
)
from services.mapping.rasterizer.projection import project
from services.mapping.rasterizer.scratch import Scratch
from services.mapping.rasterizer.simd import kernel
from services.mapping.rasterizer.threads import workers
from shared.camera import Intrinsics

CAMERA = Camera.of(View(np.eye(4), Intrinsics(120.0, 120.0, 79.5, 59.5, 160, 120)))

ALL_TILES = range(CAMERA.tiles())


@kernel
def _sort(keys, spare, histograms):
    sort_keys(keys, spare, histograms)


def _projected(count, seed=0):
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1, -1, 0.5], [1, 1, 3], (count, 3))
    splats = Splats(
        means.astype(np.float32).reshape(-1),
        np.exp(rng.normal(-3.5, 1.0, count * 3)).astype(np.float32),
        rng.normal(size=count * 4).astype(np.float32),
        rng.uniform(0.01, 1, count).astype(np.float32),
        rng.uniform(0, 1, count * 3).astype(np.float32),
    )
    projected = Projected.empty(count, CAMERA.tiles(), Scratch())
    workers(1).run(project, splats, CAMERA, projected)
    return projected


def _boxes(projected):
    """First and last column, first and last row of every Gaussian, [4, N]."""
    return projected.boxes.reshape(4, -1)


def _owners(lists: TileLists, tile):
    """The Gaussians of a tile's list."""
    keys = lists.keys[lists.tile_starts[tile] : lists.tile_starts[tile + 1]]
    return lists.owners[(keys & np.uint64(0xFFFFFFFF)).astype(np.int64)]


@pytest.mark.parametrize("count", [0, 1, 2, 47, 48, 500, 5000])
def test_keys_come_out_sorted(count):
    rng = np.random.default_rng(count)
    depths = rng.uniform(0.2, 9, count).astype(np.float32)
    depths[: count // 3] = 1.0
    keys = (depths.view(np.uint32).astype(np.uint64) << 32) | np.arange(count, dtype=np.uint64)
    expected = np.sort(keys)

    _sort(keys, np.empty(count, np.uint64), np.empty((4, 256), np.int32))

    np.testing.assert_array_equal(keys, expected)


def test_every_pixel_within_an_ellipse_lies_in_a_listed_tile():
    projected = _projected(300)
    records = projected.records.reshape(-1, RECORD)

    lists = bin_gaussians(projected, CAMERA, ALL_TILES, workers(2), Scratch())

    columns = -(-CAMERA.width // TILE)
    listed = {
        (int(gaussian), tile) for tile in range(CAMERA.tiles()) for gaussian in _owners(lists, tile)
    }
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    for index in np.nonzero(np.diff(lists.starts))[0]:
        mean_x, mean_y, e1, shear, e2, *_ = records[index].astype(np.float64)
        dx, dy = x + 0.5 - mean_x, y + 0.5 - mean_y
        exponent = (e1 * dx) ** 2 + (e2 * (dy - shear * dx)) ** 2
        inside = exponent < records[index, REACH] * (1 - 1e-4)
        tiles = set(((y // TILE) * columns + x // TILE)[inside].tolist())
        assert {(int(index), tile) for tile in tiles} <= listed


def test_the_slots_of_a_gaussian_lie_side_by_side_and_each_is_listed_once():
    projected = _projected(5000)

    lists = bin_gaussians(projected, CAMERA, ALL_TILES, workers(2), Scratch())

    np.testing.assert_array_equal(lists.owners, np.repeat(np.arange(5000), np.diff(lists.starts)))
    slots = lists.keys & np.uint64(0xFFFFFFFF)
    np.testing.assert_array_equal(np.sort(slots), np.arange(len(slots)))


def test_thin_gaussians_skip_the_tiles_of_their_box_that_they_miss():
    projected = _projected(5000)

    lists = bin_gaussians(projected, CAMERA, ALL_TILES, workers(1), Scratch())

    left, right, top, bottom = _boxes(projected)[:, :5000]
    boxed = (right - left + 1).clip(0) * (bottom - top + 1).clip(0)
    assert len(lists.owners) < boxed.sum()


def test_ranges_of_tiles_list_the_same_gaussians_as_all_tiles_at_once():
    projected = _projected(5000)
    whole = bin_gaussians(projected, CAMERA, ALL_TILES, workers(2), Scratch())

    parts = [
        bin_gaussians(projected, CAMERA, tiles, workers(2), Scratch())
        for tiles in (range(7), range(7, 8), range(8, CAMERA.tiles()))
    ]

    for lists in parts:
        for tile in range(len(lists.tile_ends)):
            expected = _owners(whole, lists.first_tile + tile)
            np.testing.assert_array_equal(_owners(lists, tile), expected)


def test_lists_too_long_for_memory_change_nothing_but_the_order_of_sums(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(500, 3, generator=generator) - torch.tensor([0.5, 0.5, -1.0])
    fields = [means, torch.full((500, 3), 0.1), torch.randn(500, 4, generator=generator)]
    fields += [torch.full((500,), 0.1), torch.rand(500, 3, generator=generator)]
    view = View(np.eye(4), Intrinsics(120.0, 120.0, 79.5, 59.5, 160, 120))
    outcomes = []

    for most in (binning.MOST_PAIRS, 1000):
        monkeypatch.setattr(binning, "MOST_PAIRS", most)
        leaves = [field.clone().requires_grad_() for field in fields]
        rendered = CpuRasterizer(2)(Gaussians(*leaves), view)
        (rendered.colour.square().sum() + rendered.depth.sum()).backward()
        outcomes.append((rendered.colour.detach(), *(leaf.grad for leaf in leaves)))

    assert torch.equal(outcomes[0][0], outcomes[1][0])
    for found, expected in zip(outcomes[1], outcomes[0], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
