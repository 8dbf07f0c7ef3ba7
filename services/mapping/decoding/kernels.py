"""The networks' forward kernel: chunks of anchors as planes of channels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.mapping.decoding.decoder import DISTANCE_SCALE, FEATURES, VIEW
from services.mapping.decoding.lane_products import (
    COLUMNS,
    STRIDE,
    add_product,
    exponential,
    fill,
)
from services.mapping.rasterizer.memory import fetch_add, load, store
from services.mapping.rasterizer.simd import LANES, allocating, inlined, kernel, maximum, splat

Array = NDArray[np.float32]
INPUTS = FEATURES + VIEW
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_SCALE, _NEAR = np.float32(DISTANCE_SCALE), np.float32(1e-6)


class Networks(NamedTuple):
    """Weights, or their gradients for every chunk, one axis each; `decoder.WEIGHTS` in order."""

    hidden_weight: Array
    hidden_bias: Array
    opacity_weight: Array
    opacity_bias: Array
    colour_weight: Array
    colour_bias: Array
    covariance_weight: Array
    covariance_bias: Array
    skip_weight: Array


class AnchorRows(NamedTuple):
    """Columns of the visible anchors, or the gradients at them, one axis each."""

    positions: Array  # V * 3
    turns: Array  # V * 4
    features: Array  # V * 32
    offsets: Array  # V * 3k
    scalings: Array  # V * 6


class Children(NamedTuple):
    """Columns of the Gaussians, or the gradients at them, one axis each."""

    means: Array  # V * k * 3
    scales: Array
    quats: Array
    opacities: Array
    colours: Array


class Shape(NamedTuple):
    """Sizes of the networks."""

    anchors: int
    children: int  # k
    hidden: int  # of one network


class Scene(NamedTuple):
    """What a view decodes."""

    rows: AnchorRows
    camera: Array  # [3], its position in the world
    networks: Networks
    shape: Shape


@kernel
def decode_chunks(scene, out, counter):
    """Fill the children of a chunk of anchors per count."""
    rows, camera, networks, shape = scene
    planes = np.zeros(num_planes(shape) * STRIDE, np.float32)
    while True:
        start = fetch_add(counter, 0, 1) * COLUMNS
        count = min(COLUMNS, shape.anchors - start)
        if count <= 0:
            return
        read_inputs(rows, camera, start, count, planes)
        hidden_layer(networks, shape, planes)
        _heads(networks, shape, planes)
        _activate(shape, planes)
        _write_children(rows, shape, (start, count), planes, out)


@inlined
def num_planes(shape):
    """Planes of a chunk: inputs, hidden layer, heads, and gradients at the three."""
    return INPUTS + FEATURES + 6 * shape.hidden + 11 * shape.children


@inlined
def read_inputs(rows, camera, start, count, planes):
    """Features, direction and distance into the first planes; zeros behind the last anchor."""
    for n in range(count):
        f = (start + n) * FEATURES
        for c in range(FEATURES):
            planes[c * STRIDE + n] = rows.features[f + c]
        p = (start + n) * 3
        x, y = rows.positions[p] - camera[0], rows.positions[p + 1] - camera[1]
        z = rows.positions[p + 2] - camera[2]
        distance = np.sqrt(x * x + y * y + z * z)
        inverse = _ONE / max(distance, _NEAR)
        direction = _rotated_back(turn_of(rows, start + n), (x * inverse, y * inverse, z * inverse))
        for axis in range(3):
            planes[(FEATURES + axis) * STRIDE + n] = direction[axis]
        planes[(FEATURES + 3) * STRIDE + n] = distance * _SCALE
    for c in range(INPUTS):
        for n in range(count, COLUMNS):
            planes[c * STRIDE + n] = _ZERO


@inlined
def turn_of(rows, anchor):
    """How an anchor was turned since it came: a unit quaternion."""
    q = anchor * 4
    return rows.turns[q], rows.turns[q + 1], rows.turns[q + 2], rows.turns[q + 3]


@inlined
def _rotated_back(turn, vector):
    """`quaternions.rotate_back` of one vector."""
    w, i, j, k = turn
    x, y, z = vector
    across_x, across_y, across_z = (
        _TWO * (j * z - k * y),
        _TWO * (k * x - i * z),
        _TWO * (i * y - j * x),
    )
    return (
        x - w * across_x + (j * across_z - k * across_y),
        y - w * across_y + (k * across_x - i * across_z),
        z - w * across_z + (i * across_y - j * across_x),
    )


@inlined
def quat_product(first, second):
    """`quaternions.product` of two quaternions."""
    a, b, c, d = first
    w, x, y, z = second
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


@inlined
def hidden_layer(networks, shape, planes):
    """Planes INPUTS and on: relu(W x + b) of the three networks."""
    wide = 3 * shape.hidden
    for j in range(wide):
        fill(planes, INPUTS + j, networks.hidden_bias[j])
    add_product((networks.hidden_weight, wide, 1), planes, (0, INPUTS), (INPUTS, wide))
    zero = splat(_ZERO)
    for j in range(INPUTS, INPUTS + wide):
        for n in range(j * STRIDE, j * STRIDE + COLUMNS, LANES):
            store(planes, n, maximum(load(planes, n), zero))


@inlined
def head_planes(shape):
    """First planes of the heads: opacity, colour, covariance."""
    first = INPUTS + 3 * shape.hidden
    return first, first + shape.children, first + 4 * shape.children


@inlined
def _heads(networks, shape, planes):
    """Opacity, colour and covariance before their activations."""
    k, h = shape.children, shape.hidden
    opacity, colour, covariance = head_planes(shape)
    for j in range(k):
        fill(planes, opacity + j, networks.opacity_bias[j])
    for j in range(3 * k):
        fill(planes, colour + j, networks.colour_bias[j])
    for j in range(7 * k):
        fill(planes, covariance + j, networks.covariance_bias[j])
    add_product((networks.opacity_weight, k, 1), planes, (INPUTS, h), (opacity, k))
    add_product((networks.colour_weight, 3 * k, 1), planes, (INPUTS + h, h), (colour, 3 * k))
    add_product((networks.skip_weight, 3 * k, 1), planes, (0, FEATURES), (colour, 3 * k))
    wide = covariance, 7 * k
    add_product((networks.covariance_weight, 7 * k, 1), planes, (INPUTS + 2 * h, h), wide)


@inlined
def _activate(shape, planes):
    """tanh of opacities, cut at zero; sigmoid of colours and of the scales' shares."""
    opacity, colour, covariance = head_planes(shape)
    zero = splat(_ZERO)
    for n in range(opacity * STRIDE, colour * STRIDE, LANES):
        tanh = _TWO / (exponential(load(planes, n) * -_TWO) + _ONE) - _ONE
        store(planes, n, maximum(tanh, zero))
    for n in range(colour * STRIDE, (covariance + 3 * shape.children) * STRIDE, LANES):
        store(planes, n, _ONE / (exponential(load(planes, n) * -_ONE) + _ONE))


@allocating
def _write_children(rows, shape, part, planes, out):
    """From planes to Gaussians next to each other."""
    k = shape.children
    start, count = part
    opacity, colour, covariance = head_planes(shape)
    sizes = np.empty(LANES, np.float32)
    for n in range(count):
        a = start + n
        sizes_of(rows, a, sizes)
        for j in range(3 * k):
            child, axis = a * 3 * k + j, j % 3
            out.means[child] = rows.positions[a * 3 + axis] + rows.offsets[child] * sizes[axis]
            out.scales[child] = planes[(covariance + j) * STRIDE + n] * sizes[3 + axis]
            out.colours[child] = planes[(colour + j) * STRIDE + n]
        for j in range(k):
            out.opacities[a * k + j] = planes[(opacity + j) * STRIDE + n]
        turn = turn_of(rows, a)
        for j in range(k):
            plane, q = covariance + 3 * k + 4 * j, (a * k + j) * 4
            x, y = planes[(plane + 1) * STRIDE + n], planes[(plane + 2) * STRIDE + n]
            own = planes[plane * STRIDE + n] + _ONE, x, y, planes[(plane + 3) * STRIDE + n]
            turned = quat_product(turn, own)
            for c in range(4):
                out.quats[q + c] = turned[c]


@inlined
def sizes_of(rows, anchor, sizes):
    """exp of an anchor's scalings, in the first six lanes."""
    for c in range(6):
        sizes[c] = rows.scalings[anchor * 6 + c]
    store(sizes, 0, exponential(load(sizes, 0)))
