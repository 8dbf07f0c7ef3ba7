"""`decoder.decode` for CPUs: SIMD kernels over chunks of anchors, on all cores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from services.mapping.decoding.decoder import FEATURES, WEIGHTS, VisibleAnchors
from services.mapping.decoding.kernels import (
    INPUTS,
    AnchorRows,
    Children,
    Networks,
    Scene,
    Shape,
    decode_chunks,
)
from services.mapping.decoding.kernels_backward import decode_chunks_backward
from services.mapping.decoding.lane_products import COLUMNS
from services.mapping.rasterizer import Gaussians
from services.mapping.rasterizer.scratch import scratch
from services.mapping.rasterizer.threads import default_threads, workers

Array = NDArray[np.float32]
_WIDTHS = 3, 3, 4, 1, 3  # of the columns of `Children`


def decode_cpu(
    visible: VisibleAnchors, camera_world: Tensor, weights: Mapping[str, Tensor]
) -> Gaussians:
    """The same as `decoder.decode`; results do not depend on the number of threads."""
    outputs = _Decode.apply(
        visible.positions,
        visible.turns,
        camera_world,
        visible.features,
        visible.offsets,
        visible.scalings,
        *(weights[name] for name in WEIGHTS),
    )
    return Gaussians(*outputs)  # pyright: ignore[reportGeneralTypeIssues]


class _Decode(torch.autograd.Function):
    """(positions, turns, camera, features, offsets, scalings, weights) -> Gaussians' columns."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore
        positions, turns, camera, *others = map(_flat, tensors)
        rows, matrices = AnchorRows(positions, turns, *others[:3]), others[3:]
        networks = Networks(*matrices)
        count, hidden = len(positions) // 3, len(networks.hidden_bias) // 3
        shape = Shape(count, len(networks.opacity_bias), hidden)
        each = count * shape.children
        out = Children(*(scratch().borrow(each * width) for width in _WIDTHS))
        ctx.scene, ctx.out = Scene(rows, camera, networks, shape), out
        _run(decode_chunks, ctx.scene, out)
        return tuple(
            torch.from_numpy(column if width == 1 else column.reshape(each, width))
            for column, width in zip(out, _WIDTHS, strict=True)
        )

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore
        rows, _, networks, shape = ctx.scene
        down = AnchorRows(*rows[:2], *(scratch().borrow(column.size) for column in rows[2:]))
        chunks = -(-shape.anchors // COLUMNS)
        slopes = Networks(*(np.empty((chunks, w.size), np.float32) for w in networks))
        passed = ctx.out, Children(*map(_flat, gradients)), down, slopes
        _run(decode_chunks_backward, ctx.scene, passed)
        trained = (column.reshape(shape.anchors, -1) for column in down[2:])
        sums = (
            slope.sum(0, dtype=np.float64).astype(np.float32).reshape(size)
            for slope, size in zip(slopes, _sizes(shape), strict=True)
        )
        return (None, None, None, *map(torch.from_numpy, trained), *map(torch.from_numpy, sums))


def _flat(tensor: Tensor) -> Array:
    return tensor.detach().contiguous().numpy().reshape(-1)


def _run(kernel: Any, *arguments: object) -> None:
    workers(default_threads()).run(kernel, *arguments)


def _sizes(shape: Shape) -> tuple[tuple[int, ...], ...]:
    """Of the weights, in order."""
    k, h = shape.children, shape.hidden
    heads = (size for width in (k, 3 * k, 7 * k) for size in ((h, width), (width,)))
    return (INPUTS, 3 * h), (3 * h,), *heads, (FEATURES, 3 * k)
