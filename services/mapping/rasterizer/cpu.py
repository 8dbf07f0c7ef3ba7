"""The CPU rasterizer: Numba kernels on our own threads, inside one autograd function."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from services.mapping.rasterizer.binning import bin_gaussians, tile_ranges
from services.mapping.rasterizer.kernel_types import (
    CHUNK,
    RECORD,
    Camera,
    Projected,
    Splats,
    TileLists,
    Tiles,
)
from services.mapping.rasterizer.projection import project
from services.mapping.rasterizer.projection_backward import (
    Gradients,
    Pairs,
    add_sums,
    first_sums,
    project_backward,
)
from services.mapping.rasterizer.scene import (
    Gaussians,
    Rendered,
    ScreenStatistics,
    View,
    WeightedSums,
)
from services.mapping.rasterizer.scratch import Scratch, scratch
from services.mapping.rasterizer.simd import LANES
from services.mapping.rasterizer.threads import Workers, default_threads, workers
from services.mapping.rasterizer.tiles_backward import blend_tiles_backward
from services.mapping.rasterizer.tiles_forward import Images, blend_tiles


class CpuRasterizer:
    """Renders Gaussians on the CPU; results do not depend on the number of threads.

    Several Python threads may use one rasterizer at the same time.
    """

    def __init__(self, threads: int | None = None, pool: Workers | None = None) -> None:
        self._engine = Engine(pool or workers(threads or default_threads()), scratch())

    def __call__(self, gaussians: Gaussians, view: View) -> Rendered:
        """Render the Gaussians; see `scene` for the definition.

        Raises:
            InputError: a tensor has a wrong shape or type, or is not finite.
        """
        gaussians.check()
        frame = self._engine.prepare(gaussians, view)
        screen = ScreenStatistics(torch.from_numpy(frame.projected.visible()))
        run = _Run(self._engine, gaussians, view, screen, frame)
        images = _Rasterize.apply(*gaussians.tensors(), view.pose(), run)
        return Rendered(*images, screen=screen)

    def with_sums(self, gaussians: Gaussians, view: View) -> tuple[Rendered, WeightedSums]:
        """Render without gradients; the sums take one pass over the tiles, see `Rasterizer`."""
        gaussians.check()
        frame = self._engine.prepare(gaussians, view)
        screen = ScreenStatistics(torch.from_numpy(frame.projected.visible()))
        rendered = Rendered(*self._engine.blend(frame), screen=screen)
        return rendered, partial(self._engine.weighted_sums, frame)


@dataclass(frozen=True)
class _Frame:
    """Gaussians projected to one view and sorted into its tiles.

    Where the lists of all tiles are too long to keep, there are several ranges of tiles, and
    each pass makes the lists of a range when it comes to it.
    """

    splats: Splats
    camera: Camera
    projected: Projected
    ranges: list[range]
    lists: TileLists | None  # None if there are several ranges

    def tiles(self, lists: TileLists) -> Tiles:
        return Tiles(self.projected.records, lists, self.camera)


@dataclass(frozen=True)
class Engine:
    """Runs the kernels of a frame, in order."""

    pool: Workers
    scratch: Scratch

    def prepare(self, gaussians: Gaussians, view: View) -> _Frame:
        camera = Camera.of(view)
        splats = Splats(*(_flat(tensor) for tensor in gaussians.tensors()))
        projected = Projected.empty(len(splats.opacities), camera.tiles(), self.scratch)
        self.pool.run(project, splats, camera, projected)
        if not projected.valid.all():
            gaussians.check_finite()
        ranges = tile_ranges(projected)
        lists = None
        if len(ranges) == 1:
            lists = bin_gaussians(projected, camera, ranges[0], self.pool, self.scratch)
        return _Frame(splats, camera, projected, ranges, lists)

    def blend(self, frame: _Frame) -> tuple[Tensor, Tensor, Tensor]:
        height, width = frame.camera.height, frame.camera.width
        images = self._empty_images(frame)
        for _ in self._blend_ranges(frame, images):
            pass
        colour, depth, alpha = (torch.from_numpy(image) for image in images)
        return colour.view(height, width, 3), depth.view(height, width), alpha.view(height, width)

    def gather(self, frame: _Frame, images: Images, gradients: Images) -> Pairs:
        """What reaches the pairs of Gaussians and tiles; nothing else needs the frame's lists."""
        if frame.lists is None:
            return self._sum_ranges(frame, images, gradients)
        return self._sum_pairs(frame, frame.lists, images, gradients)

    def differentiate(self, splats: Splats, camera: Camera, pairs: Pairs) -> Gradients:
        result = _empty_gradients(len(splats.opacities), self.scratch)
        self.pool.run(project_backward, splats, camera, pairs, result)
        return result

    def weighted_sums(self, frame: _Frame, image: Tensor) -> Tensor:
        """The last channel takes the place of depth: its derivative is a weight, too."""
        rgb, nothing = _flat(image[..., :3]), np.zeros(image[..., 3].numel(), np.float32)
        drawn = Images(np.zeros_like(rgb), nothing, nothing)  # matters to shapes only
        pairs = self.gather(frame, drawn, Images(rgb, _flat(image[..., 3]), nothing))
        sums = np.empty((frame.projected.num_gaussians, 4), np.float32)
        self.pool.run(first_sums, pairs, sums)
        return torch.from_numpy(sums)

    def _empty_images(self, frame: _Frame) -> Images:
        borrow, pixels = self.scratch.borrow, frame.camera.height * frame.camera.width
        return Images(borrow(3 * pixels), borrow(pixels), borrow(pixels))

    def _blend_ranges(self, frame: _Frame, images: Images) -> Iterator[TileLists]:
        """Blend each range of tiles; gives its sorted lists."""
        for tiles in frame.ranges:
            lists = frame.lists or bin_gaussians(
                frame.projected, frame.camera, tiles, self.pool, self.scratch
            )
            self.pool.run(blend_tiles, frame.tiles(lists), images)
            yield lists

    def _sum_pairs(
        self, frame: _Frame, lists: TileLists, images: Images, gradients: Images
    ) -> Pairs:
        sums = self.scratch.borrow(len(lists.owners) * RECORD)
        self.pool.run(blend_tiles_backward, frame.tiles(lists), images, gradients, sums)
        return Pairs(lists.starts, sums)

    def _sum_ranges(self, frame: _Frame, images: Images, gradients: Images) -> Pairs:
        """One record per visible Gaussian; the lists of a range, gone since, are made again."""
        visible = frame.projected.visible()
        starts = np.zeros(len(visible) + 1, np.int32)
        np.cumsum(visible, out=starts[1:])
        totals = Pairs(starts, np.zeros(int(starts[-1]) * RECORD, np.float32))
        for lists in self._blend_ranges(frame, self._empty_images(frame)):
            self.pool.run(add_sums, self._sum_pairs(frame, lists, images, gradients), totals)
        return totals


@dataclass
class _Run:
    """One forward pass, and where its backward pass leaves the statistics."""

    engine: Engine
    gaussians: Gaussians
    view: View
    screen: ScreenStatistics
    frame: _Frame | None

    def take_frame(self) -> _Frame:
        """The frame, which is let go of with the last pair; made again for a second backward."""
        frame, self.frame = self.frame, None
        if frame is None:
            frame = self.engine.prepare(self.gaussians, self.view)
            self.engine.blend(frame)
        return frame


class _Rasterize(torch.autograd.Function):
    """(means, scales, quats, opacities, colours, pose) -> (colour, depth, alpha)."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
        *_, pose, ctx.run = inputs
        ctx.pose = pose.dtype, pose.device
        images = ctx.run.engine.blend(ctx.run.frame)
        ctx.save_for_backward(*images)
        return images

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        images = _images(ctx.saved_tensors)
        engine, frame = ctx.run.engine, ctx.run.take_frame()
        pairs = engine.gather(frame, images, _images(gradients))
        splats, camera = frame.splats, frame.camera
        del frame  # the gradients take its place in memory
        result = engine.differentiate(splats, camera, pairs)
        ctx.run.screen.gradient_norm = torch.from_numpy(result.screen)
        fields = (
            torch.from_numpy(array.reshape(shape))
            for array, shape in zip(result[:5], _SHAPES, strict=True)
        )
        return *fields, _pose_gradient(result.poses, *ctx.pose), None


_SHAPES = (-1, 3), (-1, 3), (-1, 4), (-1,), (-1, 3)


def _flat(tensor: Tensor) -> NDArray[np.float32]:
    """The tensor as an array of one axis; its own memory where it is contiguous."""
    return tensor.detach().contiguous().numpy().reshape(-1)


def _images(tensors: tuple[Tensor, ...]) -> Images:
    return Images(*(_flat(tensor) for tensor in tensors))


def _empty_gradients(count: int, scratch: Scratch) -> Gradients:
    """Views of the right size of arrays with room for whole vectors of Gaussians."""
    padded = -(-count // LANES) * LANES
    arrays = (scratch.borrow(padded * width)[: count * width] for width in (3, 3, 4, 1, 3, 1))
    return Gradients(*arrays, poses=np.empty((-(-count // CHUNK), 12 * LANES), np.float32))


def _pose_gradient(poses: NDArray[np.float32], dtype: torch.dtype, device: Any) -> Tensor:
    """Sum over chunks and lanes to dL/dT_camera_world, [4, 4]."""
    gradient = np.zeros((4, 4))
    gradient[:3] = poses.reshape(-1, 12, LANES).sum(axis=(0, 2), dtype=np.float64).reshape(3, 4)
    return torch.from_numpy(gradient).to(device, dtype)
