"""From lanes to numbers: tests, single lanes, and rounding to an index."""

from __future__ import annotations

import llvmlite.ir as ir
from numba.core import cgutils, types

from services.mapping.rasterizer.simd import LANES, intrinsic

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
def all_lanes(typing_context, mask):
    """Whether the mask holds everywhere."""

    def generate(context, builder, sig, args):
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("==", builder.bitcast(args[0], bits), bits(2**LANES - 1))

    return types.boolean(mask), generate


@intrinsic
def lane(typing_context, vector, index):
    """One lane as a number."""

    def generate(context, builder, sig, args):
        position = context.cast(builder, args[1], sig.args[1], types.int64)
        return builder.extract_element(args[0], builder.trunc(position, _INT32))

    return types.float32(vector, index), generate


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
