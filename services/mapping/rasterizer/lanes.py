"""From lanes to numbers: tests, single lanes, horizontal sums, and rounding to an index."""

from __future__ import annotations

import llvmlite.ir as ir
from numba.core import cgutils, types

from services.mapping.rasterizer.simd import FAST_MATH, LANES, float8, intrinsic, shuffle

_FLOAT = ir.FloatType()
_INT32 = ir.IntType(32)
_INT64 = ir.IntType(64)


@intrinsic
def any_lane(typing_context, mask):
    """Whether the mask holds anywhere."""

    def generate(context, builder, sig, args):
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), bits(0))

    return types.boolean(mask), generate


@intrinsic
def lane(typing_context, vector, index):
    """One lane as a number."""

    def generate(context, builder, sig, args):
        position = context.cast(builder, args[1], sig.args[1], types.int64)
        return builder.extract_element(args[0], builder.trunc(position, _INT32))

    return types.float32(vector, index), generate


# A shuffle tree: each step adds neighbours, so that 8 sums cost 7 additions instead of 8 x 3.
_TREE = (
    ([0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15]),
    ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]),
    ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]),
)


def _add_neighbours(builder, level: int, x, y):
    even, odd = _TREE[level]
    return builder.fadd(shuffle(builder, x, y, even), shuffle(builder, x, y, odd), flags=FAST_MATH)


@intrinsic
def lane_sums(typing_context, a, b, c, d, e, f, g, h):  # noqa: PLR0913 - one per lane
    """The horizontal sums of 8 vectors, as one vector."""

    def generate(context, builder, sig, args):
        vectors = list(args)
        for level in range(3):
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [_add_neighbours(builder, level, x, y) for x, y in pairs]
        return vectors[0]

    return float8(a, b, c, d, e, f, g, h), generate


@intrinsic
def lane_sums_of_two(typing_context, a, b):
    """The horizontal sums of 2 vectors, in lanes 0 and 1."""

    def generate(context, builder, sig, args):
        sums = _add_neighbours(builder, 0, *args)
        sums = _add_neighbours(builder, 1, sums, sums)
        return _add_neighbours(builder, 2, sums, sums)

    return float8(a, b), generate


def _rounded(name: str):
    """Code that rounds a float32 by an LLVM function and gives an int64."""

    def generate(context, builder, sig, args):
        kind = ir.FunctionType(_FLOAT, [_FLOAT])
        whole = builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)
        return builder.sext(builder.fptosi(whole, _INT32), _INT64)

    return generate


@intrinsic
def ceil_index(typing_context, x):
    """The least whole number not below a float32."""
    return types.int64(x), _rounded("llvm.ceil.f32")


@intrinsic
def floor_index(typing_context, x):
    """The greatest whole number not above a float32."""
    return types.int64(x), _rounded("llvm.floor.f32")
