"""Vectors of places and of powers: columns and rows of a strip, rounding, exponents."""

from __future__ import annotations

import llvmlite.ir as ir
from numba.core import types

from services.mapping.rasterizer.simd import (
    LANES,
    STRIP_COLUMNS,
    by_llvm,
    fixed,
    floats,
    floats_ir,
    intrinsic,
)

_INTS = ir.VectorType(ir.IntType(32), LANES)


@intrinsic
def ramp(typing_context):
    """The lanes 0, 1, 2 ..."""
    return fixed(range(LANES))


@intrinsic
def strip_columns(typing_context):
    """The column of each lane of a strip: 0 to 7, in every row."""
    return fixed(lane % STRIP_COLUMNS for lane in range(LANES))


@intrinsic
def strip_rows(typing_context):
    """The row of each lane of a strip."""
    return fixed(lane // STRIP_COLUMNS for lane in range(LANES))


@intrinsic
def round_down(typing_context, x):
    """The greatest whole number not above each lane."""
    return floats(x), by_llvm("floor")


@intrinsic
def round_up(typing_context, x):
    """The least whole number not below each lane."""
    return floats(x), by_llvm("ceil")


@intrinsic
def split_exponent(typing_context, x):
    """(e, m) of each positive lane x = 2^e m, with m from 0.7071 to 1.4142."""

    def generate(context, builder, sig, args):
        bits = builder.bitcast(args[0], _INTS)
        above = builder.sub(bits, ir.Constant(_INTS, [0x3F3504F3] * LANES))
        exponent = builder.ashr(above, ir.Constant(_INTS, [23] * LANES))
        rest = builder.sub(bits, builder.shl(exponent, ir.Constant(_INTS, [23] * LANES)))
        parts = builder.sitofp(exponent, floats_ir), builder.bitcast(rest, floats_ir)
        return context.make_tuple(builder, sig.return_type, parts)

    return types.UniTuple(floats, 2)(x), generate
