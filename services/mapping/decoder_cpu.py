"""`decoder.decode` for CPUs: pieces that fit the cache, on all cores, with its own backward.

Products of pieces of a few thousand rows run at 90 GFLOP/s on a core, those of whole matrices that
leave the cache at 17; autograd's graph would do the latter. Products go through torch, whose
number of threads can be set at run time: a BLAS with threads of its own under ours was measured
to be ten times slower.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.decoder import (
    DISTANCE_SCALE,
    FEATURES,
    VIEW,
    WEIGHTS,
    VisibleAnchors,
)
from services.mapping.rasterizer import Gaussians
from services.mapping.workers import in_pieces

Array = NDArray[np.float32]
_PIECE = 4096
_OUTPUTS = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "colours": 3}
_HALF, _ONE = np.float32(0.5), np.float32(1.0)


def decode_cpu(
    visible: VisibleAnchors, camera_world: Tensor, weights: Mapping[str, Tensor]
) -> Gaussians:
    """The same as `decoder.decode`."""
    outputs = _Decode.apply(
        visible.positions,
        camera_world,
        visible.features,
        visible.offsets,
        visible.scalings,
        *(weights[name] for name in WEIGHTS),
    )
    return Gaussians(*outputs)  # pyright: ignore[reportGeneralTypeIssues]


@dataclass(frozen=True)
class _Inputs:
    """Rows of the visible anchors, numpy views."""

    positions: Array
    features: Array
    offsets: Array  # [V, k, 3]
    scalings: Array


@dataclass(frozen=True)
class _Piece:
    """What the backward pass needs of one piece of the forward pass."""

    rows: slice
    inputs: Array  # [n, 36]
    hidden: Array  # [n, 3h]
    opacities: Array  # [n, k], before the cut at zero
    sizes: Array  # [n, 6], exp(scalings)


@dataclass(frozen=True)
class _BackwardPass:
    """What all pieces of a backward pass share."""

    rows: _Inputs
    weights: dict[str, Array]
    out: dict[str, Array]  # of the forward pass
    upstream: dict[str, Array]  # gradients at `out`
    down: _Inputs  # gradients at `rows`, to be filled


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore
        positions, camera, features, offsets, scalings, *matrices = (
            t.detach().numpy() for t in tensors
        )
        k = offsets.shape[1] // 3
        rows = _Inputs(positions, features, offsets.reshape(-1, k, 3), scalings)
        weights: dict[str, Array] = dict(zip(WEIGHTS, matrices, strict=True))
        out = {name: np.empty((len(positions), k, w), np.float32) for name, w in _OUTPUTS.items()}

        def work(start: int, stop: int) -> _Piece:
            return _forward(rows, slice(start, stop), camera, weights, out)

        ctx.pieces = in_pieces(work, len(positions), _PIECE)
        ctx.rows, ctx.weights, ctx.out = rows, weights, out
        shapes = {name: (-1,) if width == 1 else (-1, width) for name, width in _OUTPUTS.items()}
        return tuple(torch.from_numpy(out[name].reshape(shapes[name])) for name in _OUTPUTS)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore
        rows: _Inputs = ctx.rows
        count, k = rows.offsets.shape[:2]
        upstream = {
            name: gradient.numpy().reshape(count, k, _OUTPUTS[name])
            for name, gradient in zip(_OUTPUTS, gradients, strict=True)
        }
        down = _Inputs(*(np.empty_like(a) for a in (rows.positions, *_trained(rows))))
        passed = _BackwardPass(rows, ctx.weights, ctx.out, upstream, down)

        def work(start: int, stop: int) -> dict[str, NDArray[Any]]:
            piece = ctx.pieces[start // _PIECE]
            return _backward(piece, passed)

        parts = in_pieces(work, count, _PIECE)
        sums = [sum(part[name] for part in parts) for name in WEIGHTS]
        trained = [torch.from_numpy(a.reshape(count, -1)) for a in _trained(down)]
        return (None, None, *trained, *(torch.from_numpy(np.asarray(s)) for s in sums))


def _trained(rows: _Inputs) -> tuple[Array, Array, Array]:
    return rows.features, rows.offsets, rows.scalings


def _product(a: NDArray[Any], b: NDArray[Any]) -> Array:
    """a @ b on this thread."""
    return torch.mm(torch.from_numpy(a), torch.from_numpy(b)).numpy()


def _over_children(values: Array) -> Array:
    """Sum of [n, k, 3] over k; a product is five times faster than numpy's sum here."""
    count, k, width = values.shape
    fold = np.tile(np.eye(width, dtype=np.float32), (k, 1))
    return _product(values.reshape(count, k * width), fold)


def _over_rows(values: Array) -> Array:
    """Sum of [n, m] over n."""
    return _product(np.ones((1, len(values)), np.float32), values)[0]


def _sigmoid(x: Array) -> Array:
    """In place; through tanh, which is vectorised."""
    x *= _HALF
    np.tanh(x, out=x)
    x += _ONE
    x *= _HALF
    return x


def _forward(
    rows: _Inputs, part: slice, camera: Array, weights: dict[str, Array], out: dict[str, Array]
) -> _Piece:
    inputs = _network_inputs(rows, part, camera)
    hidden = _product(inputs, weights["hidden_weight"])
    hidden += weights["hidden_bias"]
    np.maximum(hidden, 0.0, out=hidden)
    h = hidden.shape[1] // 3
    count, k = len(inputs), rows.offsets.shape[1]

    opacities = np.tanh(
        _product(hidden[:, :h], weights["opacity_weight"]) + weights["opacity_bias"]
    )
    np.maximum(opacities, 0.0, out=out["opacities"][part, :, 0])
    colours = _product(hidden[:, h : 2 * h], weights["colour_weight"])
    colours += _product(inputs[:, :FEATURES], weights["skip_weight"])
    colours += weights["colour_bias"]
    out["colours"][part] = _sigmoid(colours).reshape(count, k, 3)
    covariance = _product(hidden[:, 2 * h :], weights["covariance_weight"])
    covariance += weights["covariance_bias"]
    sizes = np.exp(rows.scalings[part])
    shares = _sigmoid(np.ascontiguousarray(covariance[:, : 3 * k])).reshape(count, k, 3)
    np.multiply(shares, sizes[:, None, 3:], out=out["scales"][part])
    out["quats"][part] = covariance[:, 3 * k :].reshape(count, k, 4)
    out["quats"][part, :, 0] += _ONE
    np.multiply(rows.offsets[part], sizes[:, None, :3], out=out["means"][part])  # Eq. 5
    out["means"][part] += rows.positions[part, None]
    return _Piece(part, inputs, hidden, opacities, sizes)


def _network_inputs(rows: _Inputs, part: slice, camera: Array) -> Array:
    direction = rows.positions[part] - camera
    distance = np.sqrt(np.einsum("ij,ij->i", direction, direction))[:, None]
    inputs = np.empty((len(direction), FEATURES + VIEW), np.float32)
    inputs[:, :FEATURES] = rows.features[part]
    np.divide(direction, np.maximum(distance, 1e-6), out=inputs[:, FEATURES:-1])
    inputs[:, -1:] = distance * np.float32(DISTANCE_SCALE)
    return inputs


def _backward(piece: _Piece, passed: _BackwardPass) -> dict[str, NDArray[Any]]:
    """Gradients of one piece: rows into `down`, weights as the result."""
    part, count, down = piece.rows, len(piece.inputs), passed.down
    rows, weights, out, upstream = passed.rows, passed.weights, passed.out, passed.upstream
    h = piece.hidden.shape[1] // 3
    scales, colours = out["scales"][part], out["colours"][part]
    sizes, quats = piece.sizes[:, None], upstream["quats"][part].reshape(count, -1)
    by_scale = upstream["scales"][part] * scales
    by_mean = upstream["means"][part] * sizes[..., :3]
    down.offsets[part] = by_mean
    down.scalings[part, 3:] = _over_children(by_scale)
    down.scalings[part, :3] = _over_children(by_mean * rows.offsets[part])

    drawn = (piece.opacities > 0.0) * (_ONE - np.square(piece.opacities))
    by_opacity = upstream["opacities"][part].reshape(count, -1) * drawn
    by_colour = (upstream["colours"][part] * colours * (_ONE - colours)).reshape(count, -1)
    by_share = (by_scale * (_ONE - scales / sizes[..., 3:])).reshape(count, -1)
    by_covariance = np.concatenate([by_share, quats], axis=1)
    heads = {"opacity": by_opacity, "colour": by_colour, "covariance": by_covariance}

    by_hidden = np.empty_like(piece.hidden)
    result: dict[str, NDArray[Any]] = {}
    for i, (name, gradient) in enumerate(heads.items()):
        columns = slice(i * h, (i + 1) * h)
        by_hidden[:, columns] = _product(gradient, weights[f"{name}_weight"].T)
        result[f"{name}_weight"] = _product(piece.hidden[:, columns].T, gradient)
        result[f"{name}_bias"] = _over_rows(gradient)
    by_hidden *= piece.hidden > 0.0
    features = _product(by_hidden, weights["hidden_weight"][:FEATURES].T)
    features += _product(by_colour, weights["skip_weight"].T)
    down.features[part] = features
    result["hidden_weight"] = _product(piece.inputs.T, by_hidden)
    result["hidden_bias"] = _over_rows(by_hidden)
    result["skip_weight"] = _product(piece.inputs[:, :FEATURES].T, by_colour)
    return result
