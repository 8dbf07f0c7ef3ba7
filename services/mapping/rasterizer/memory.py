"""Memory access for the kernels: vectors, raw elements, atomic counters and prefetching.

Nothing here checks bounds; callers keep indices inside the array.
"""

from __future__ import annotations

import llvmlite.ir as ir
from numba.core import cgutils, types

from services.mapping.rasterizer.simd import float8, float8_ir, intrinsic

_INT32 = ir.IntType(32)


def _pointer(context, builder, sig, args):
    """Address of element `args[1]` of the array `args[0]`; no bounds, no negative indices."""
    array = context.make_array(sig.args[0])(context, builder, args[0])
    return builder.gep(array.data, [context.cast(builder, args[1], sig.args[1], types.intp)])


@intrinsic
def load(typing_context, array, index):
    """8 consecutive elements of a float32 array."""

    def generate(context, builder, sig, args):
        address = builder.bitcast(_pointer(context, builder, sig, args), float8_ir.as_pointer())
        lanes = builder.load(address)
        lanes.align = 4
        return lanes

    return float8(array, index), generate


@intrinsic
def store(typing_context, array, index, vector):
    """Write 8 consecutive elements of a float32 array."""

    def generate(context, builder, sig, args):
        address = builder.bitcast(_pointer(context, builder, sig, args), float8_ir.as_pointer())
        builder.store(args[2], address).align = 4
        return context.get_dummy_value()

    return types.none(array, index, vector), generate


@intrinsic
def element(typing_context, array, index):
    """One element, without the code for negative indices."""

    def generate(context, builder, sig, args):
        return builder.load(_pointer(context, builder, sig, args))

    return array.dtype(array, index), generate


@intrinsic
def fetch_add(typing_context, array, index, amount):
    """Add to an element atomically; gives its value before."""

    def generate(context, builder, sig, args):
        number = context.cast(builder, args[2], sig.args[2], sig.args[0].dtype)
        return builder.atomic_rmw("add", _pointer(context, builder, sig, args), number, "monotonic")

    return array.dtype(array, index, amount), generate


@intrinsic
def prefetch(typing_context, array, index):
    """Ask for the cache line of an element that will be read soon."""

    def generate(context, builder, sig, args):
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, _INT32, _INT32, _INT32])
        hint = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        address = builder.bitcast(_pointer(context, builder, sig, args), byte)
        builder.call(hint, [address, _INT32(0), _INT32(3), _INT32(1)])
        return context.get_dummy_value()

    return types.none(array, index), generate
