"""The networks' backward kernel.

It computes the hidden layer again instead of keeping it: writing and reading 100 numbers per
anchor costs more.
"""

from __future__ import annotations

import numpy as np

from services.mapping.decoding.decoder import FEATURES
from services.mapping.decoding.kernels import (
    INPUTS,
    head_planes,
    hidden_layer,
    num_planes,
    quat_product,
    read_inputs,
    sizes_of,
    turn_of,
)
from services.mapping.decoding.lane_products import (
    COLUMNS,
    STRIDE,
    add_product,
    fill,
    outer_product,
    plane_sums,
)
from services.mapping.rasterizer.memory import fetch_add, load, store
from services.mapping.rasterizer.simd import LANES, allocating, inlined, kernel, select, splat

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@kernel
def decode_chunks_backward(scene, passed, counter):
    """Fill the gradients; `passed` is (children, gradients there, at rows, at networks)."""
    rows, camera, networks, shape = scene
    children, upstream, down, slopes = passed
    planes = np.zeros(num_planes(shape) * STRIDE, np.float32)
    while True:
        chunk = fetch_add(counter, 0, 1)
        start = chunk * COLUMNS
        count = min(COLUMNS, shape.anchors - start)
        if count <= 0:
            return
        read_inputs(rows, camera, start, count, planes)
        hidden_layer(networks, shape, planes)
        _geometry_backward(rows, shape, (start, count), (children, upstream), down)
        _heads_backward(rows, shape, (start, count), (children, upstream), planes)
        _layers_backward(networks, shape, planes)
        _weights_backward(shape, planes, chunk, slopes)
        _write_features(planes, _gradient_planes(shape)[1], (start, count), down.features)


@allocating
def _geometry_backward(rows, shape, part, passed, down):
    """Gradients at offsets and scalings; the sizes' shares come with the heads."""
    k = shape.children
    children, upstream = passed
    sizes = np.zeros(LANES, np.float32)
    for a in range(part[0], part[0] + part[1]):
        sizes_of(rows, a, sizes)
        for axis in range(3):
            unit = size = _ZERO
            for j in range(axis, 3 * k, 3):
                child = a * 3 * k + j
                by_mean = upstream.means[child] * sizes[axis]
                down.offsets[child] = by_mean
                unit += by_mean * rows.offsets[child]
                size += upstream.scales[child] * children.scales[child]
            down.scalings[a * 6 + axis] = unit
            down.scalings[a * 6 + 3 + axis] = size


@allocating
def _heads_backward(rows, shape, part, passed, planes):
    """Gradients before the activations into the heads' planes; zeros behind the last anchor."""
    k = shape.children
    start, count = part
    children, upstream = passed
    opacity, colour, covariance = head_planes(shape)
    sizes = np.zeros(LANES, np.float32)
    for n in range(count):
        a = start + n
        sizes_of(rows, a, sizes)
        for j in range(k):
            value = children.opacities[a * k + j]
            slope = _ONE - value * value if value > _ZERO else _ZERO
            planes[(opacity + j) * STRIDE + n] = upstream.opacities[a * k + j] * slope
        for j in range(3 * k):
            child = a * 3 * k + j
            value, scale = children.colours[child], children.scales[child]
            share = scale * (_ONE - scale / sizes[3 + j % 3])
            planes[(colour + j) * STRIDE + n] = upstream.colours[child] * value * (_ONE - value)
            planes[(covariance + j) * STRIDE + n] = upstream.scales[child] * share
        w, x, y, z = turn_of(rows, a)
        for j in range(k):
            q = (a * k + j) * 4
            up = (
                upstream.quats[q],
                upstream.quats[q + 1],
                upstream.quats[q + 2],
                upstream.quats[q + 3],
            )
            own = quat_product((w, -x, -y, -z), up)  # turning keeps lengths
            for c in range(4):
                planes[(covariance + 3 * k + 4 * j + c) * STRIDE + n] = own[c]
    for j in range(11 * k):
        for n in range(count, COLUMNS):
            planes[(opacity + j) * STRIDE + n] = _ZERO


@inlined
def _gradient_planes(shape):
    """First planes of the gradients at the hidden layer and at the features."""
    hidden = INPUTS + 3 * shape.hidden + 11 * shape.children
    return hidden, hidden + 3 * shape.hidden


@inlined
def _layers_backward(networks, shape, planes):
    """From the heads through the hidden layer to the features."""
    k, h = shape.children, shape.hidden
    opacity, colour, covariance = head_planes(shape)
    hidden, features = _gradient_planes(shape)
    for j in range(hidden, features + FEATURES):
        fill(planes, j, _ZERO)
    add_product((networks.opacity_weight, 1, k), planes, (opacity, k), (hidden, h))
    add_product((networks.colour_weight, 1, 3 * k), planes, (colour, 3 * k), (hidden + h, h))
    narrow = hidden + 2 * h, h
    add_product((networks.covariance_weight, 1, 7 * k), planes, (covariance, 7 * k), narrow)
    zero = splat(_ZERO)
    shift = (hidden - INPUTS) * STRIDE
    for n in range(INPUTS * STRIDE, (INPUTS + 3 * h) * STRIDE, LANES):
        gradient = load(planes, n + shift)
        store(planes, n + shift, select(load(planes, n) > zero, gradient, zero))
    wide = 3 * h
    add_product((networks.hidden_weight, 1, wide), planes, (hidden, wide), (features, FEATURES))
    add_product((networks.skip_weight, 1, 3 * k), planes, (colour, 3 * k), (features, FEATURES))


@allocating
def _weights_backward(shape, planes, chunk, slopes):
    """This chunk's gradients at all weights and biases."""
    k, h = shape.children, shape.hidden
    opacity, colour, covariance = head_planes(shape)
    hidden, _ = _gradient_planes(shape)
    heads = (opacity, k), (colour, 3 * k), (covariance, 7 * k)
    inner = (INPUTS, h), (INPUTS + h, h), (INPUTS + 2 * h, h)
    outer_product(planes, (0, INPUTS), (hidden, 3 * h), slopes.hidden_weight[chunk])
    outer_product(planes, inner[0], heads[0], slopes.opacity_weight[chunk])
    outer_product(planes, inner[1], heads[1], slopes.colour_weight[chunk])
    outer_product(planes, inner[2], heads[2], slopes.covariance_weight[chunk])
    outer_product(planes, (0, FEATURES), heads[1], slopes.skip_weight[chunk])
    plane_sums(planes, (hidden, 3 * h), slopes.hidden_bias[chunk])
    plane_sums(planes, heads[0], slopes.opacity_bias[chunk])
    plane_sums(planes, heads[1], slopes.colour_bias[chunk])
    plane_sums(planes, heads[2], slopes.covariance_bias[chunk])


@inlined
def _write_features(planes, first, part, features):
    """The gradients at the features, back to rows."""
    for n in range(part[1]):
        f = (part[0] + n) * FEATURES
        for c in range(FEATURES):
            features[f + c] = planes[(first + c) * STRIDE + n]
