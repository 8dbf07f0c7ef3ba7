"""Products of skinny matrices for kernels, in SIMD lanes, and exp.

Values lie in planes: plane p holds one channel of up to `COLUMNS` items. Matrices of a few dozen
rows and columns stay in the nearest cache; a general BLAS reached a fifth of this speed on them.
"""

from __future__ import annotations

import llvmlite.ir as ir
import numpy as np
from numba.core import cgutils, types

from services.mapping.rasterizer.memory import element, load, store
from services.mapping.rasterizer.simd import (
    LANES,
    floats,
    floats_ir,
    inlined,
    intrinsic,
    maximum,
    minimum,
    splat,
)

COLUMNS = 256  # items in a plane
STRIDE = COLUMNS + LANES  # of planes; no power of two, so that columns spread over the cache's sets

_WHOLE = ir.VectorType(ir.IntType(32), LANES)
_LOG2_E = np.float32(1.44269504)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_EXP_LIMIT = np.float32(87.0)
# (exp(x) - 1 - x) / x^2 on [-ln 2 / 2, ln 2 / 2], least maximum error (Cephes' expf).
_EXP = tuple(
    np.float32(c)
    for c in (
        5.0000001201e-1,
        1.6666665459e-1,
        4.1665795894e-2,
        8.3334519073e-3,
        1.3981999507e-3,
        1.9875691500e-4,
    )
)


@intrinsic
def _nearest_whole(typing_context, x):
    """The nearest whole number of every lane, as a float."""

    def generate(context, builder, sig, args):
        kind = ir.FunctionType(floats_ir, [floats_ir])
        name = f"llvm.nearbyint.v{LANES}f32"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)

    return floats(x), generate


@intrinsic
def _power_of_two(typing_context, x):
    """2^x for whole numbers in [-126, 127]: they become the exponent's bits."""

    def generate(context, builder, sig, args):
        whole = builder.fptosi(args[0], _WHOLE)
        biased = builder.add(whole, ir.Constant(_WHOLE, [127] * LANES))
        return builder.bitcast(builder.shl(biased, ir.Constant(_WHOLE, [23] * LANES)), floats_ir)

    return floats(x), generate


@intrinsic
def lane_sum(typing_context, x):
    """The sum of all lanes, as a number; added as a tree."""

    def generate(context, builder, sig, args):
        kind = ir.FunctionType(ir.FloatType(), [ir.FloatType(), floats_ir])
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [ir.FloatType()(-0.0), args[0]], fastmath=("reassoc",))

    return types.float32(x), generate


@inlined
def exponential(x):
    """exp of every lane, relative error 2e-7; the argument is cut at +-87."""
    x = minimum(maximum(x, -_EXP_LIMIT), _EXP_LIMIT)
    whole = _nearest_whole(x * _LOG2_E)
    r = x - whole * _LN2_HIGH - whole * _LN2_LOW
    p = splat(_EXP[5])
    for c in (_EXP[4], _EXP[3], _EXP[2], _EXP[1], _EXP[0]):
        p = p * r + c
    return (p * (r * r) + r + np.float32(1.0)) * _power_of_two(whole)


@inlined
def fill(planes, plane, value):
    """Set a whole plane."""
    lanes = splat(value)
    for n in range(0, COLUMNS, LANES):
        store(planes, plane * STRIDE + n, lanes)


@inlined
def add_product(matrix, planes, source, target):
    """target[j] += sum over i of matrix[i, j] source[i].

    `matrix` is (values, step of i, step of j); `source` and `target` are (first plane, planes).
    """
    whole = target[1] // 5 * 5
    for n in range(0, COLUMNS, 2 * LANES):
        for j in range(0, whole, 5):
            _add_to_five(matrix, planes, (source[0], source[1], n), (target[0] + j, j))
        for j in range(whole, target[1]):
            _add_to_one(matrix, planes, (source[0], source[1], n), (target[0] + j, j))


@inlined
def _add_to_five(matrix, planes, source, target):
    """Five planes, two vectors each: ten sums that do not wait for each other."""
    values, step, across = matrix
    at = target[0] * STRIDE + source[2]
    a0, b0 = load(planes, at), load(planes, at + LANES)
    a1, b1 = load(planes, at + STRIDE), load(planes, at + STRIDE + LANES)
    a2, b2 = load(planes, at + 2 * STRIDE), load(planes, at + 2 * STRIDE + LANES)
    a3, b3 = load(planes, at + 3 * STRIDE), load(planes, at + 3 * STRIDE + LANES)
    a4, b4 = load(planes, at + 4 * STRIDE), load(planes, at + 4 * STRIDE + LANES)
    for i in range(source[1]):
        place = (source[0] + i) * STRIDE + source[2]
        x, y = load(planes, place), load(planes, place + LANES)
        w = i * step + target[1] * across
        w0, w1, w2 = (
            element(values, w),
            element(values, w + across),
            element(values, w + 2 * across),
        )
        w3, w4 = element(values, w + 3 * across), element(values, w + 4 * across)
        a0, b0 = a0 + x * w0, b0 + y * w0
        a1, b1 = a1 + x * w1, b1 + y * w1
        a2, b2 = a2 + x * w2, b2 + y * w2
        a3, b3 = a3 + x * w3, b3 + y * w3
        a4, b4 = a4 + x * w4, b4 + y * w4
    for row, pair in enumerate(((a0, b0), (a1, b1), (a2, b2), (a3, b3), (a4, b4))):
        store(planes, at + row * STRIDE, pair[0])
        store(planes, at + row * STRIDE + LANES, pair[1])


@inlined
def _add_to_one(matrix, planes, source, target):
    values, step, across = matrix
    at = target[0] * STRIDE + source[2]
    a, b = load(planes, at), load(planes, at + LANES)
    for i in range(source[1]):
        place = (source[0] + i) * STRIDE + source[2]
        w = element(values, i * step + target[1] * across)
        a, b = a + load(planes, place) * w, b + load(planes, place + LANES) * w
    store(planes, at, a)
    store(planes, at + LANES, b)


@inlined
def outer_product(planes, left, right, result):
    """matrix[i, j] = sum over columns of left[i] right[j].

    `left` and `right` are (first plane, planes); `result` is the matrix, flat.
    """
    for i in range(0, left[1], 2):
        second = min(i + 1, left[1] - 1)
        for j in range(0, right[1], 4):
            rows = (left[0] + i) * STRIDE, (left[0] + second) * STRIDE
            sums = _column_sums(planes, rows, (right[0] + j, right[0] + right[1] - 1))
            for c in range(min(4, right[1] - j)):
                result[i * right[1] + j + c] = sums[0][c]
                result[second * right[1] + j + c] = sums[second - i][c]


@inlined
def _column_sums(planes, rows, columns):
    """Sums of the products of 2 planes with 4, repeating the last one: two rows of four."""
    first, last = columns
    c0, c1 = first * STRIDE, min(first + 1, last) * STRIDE
    c2, c3 = min(first + 2, last) * STRIDE, min(first + 3, last) * STRIDE
    zero = splat(np.float32(0.0))
    s00, s01, s02, s03 = zero, zero, zero, zero
    s10, s11, s12, s13 = zero, zero, zero, zero
    for n in range(0, COLUMNS, LANES):
        x, y = load(planes, rows[0] + n), load(planes, rows[1] + n)
        a, b = load(planes, c0 + n), load(planes, c1 + n)
        c, d = load(planes, c2 + n), load(planes, c3 + n)
        s00, s01, s02, s03 = s00 + x * a, s01 + x * b, s02 + x * c, s03 + x * d
        s10, s11, s12, s13 = s10 + y * a, s11 + y * b, s12 + y * c, s13 + y * d
    return (
        (lane_sum(s00), lane_sum(s01), lane_sum(s02), lane_sum(s03)),
        (lane_sum(s10), lane_sum(s11), lane_sum(s12), lane_sum(s13)),
    )


@inlined
def plane_sums(planes, group, result):
    """The sum of each plane of `group`, (first plane, planes)."""
    for p in range(group[1]):
        total = splat(np.float32(0.0))
        for n in range((group[0] + p) * STRIDE, (group[0] + p) * STRIDE + COLUMNS, LANES):
            total = total + load(planes, n)
        result[p] = lane_sum(total)
