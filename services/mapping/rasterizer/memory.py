"""Memory access for the kernels: vectors, raw elements, atomic counters and prefetching.

Nothing here checks bounds; callers keep indices inside the array.
"""

from __future__ import annotations

import llvmlite.ir as ir
from numba.core import cgutils, types

from services.mapping.rasterizer.simd import (
    LANES,
    STRIP_COLUMNS,
    STRIP_ROWS,
    floats,
    floats_ir,
    intrinsic,
    shuffle,
)

_INT32 = ir.IntType(32)
_STRIP_ROW = ir.VectorType(ir.FloatType(), STRIP_COLUMNS)


def pointer(context, builder, sig, args, step=0):
    """Address of the element `step` after element `args[1]` of the array `args[0]`."""
    array = context.make_array(sig.args[0])(context, builder, args[0])
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    return builder.gep(array.data, [builder.add(index, ir.IntType(64)(step))])


def load_unaligned(builder, address, kind=floats_ir):
    """The vector that starts at an element."""
    lanes = builder.load(builder.bitcast(address, kind.as_pointer()))
    lanes.align = 4
    return lanes


def store_unaligned(builder, vector, address):
    """Write a vector from an element on."""
    target = builder.bitcast(address, vector.type.as_pointer())
    builder.store(vector, target).align = 2


@intrinsic
def load(typing_context, array, index):
    """LANES consecutive elements of a float32 array."""

    def generate(context, builder, sig, args):
        return load_unaligned(builder, pointer(context, builder, sig, args))

    return floats(array, index), generate


@intrinsic
def store(typing_context, array, index, vector):
    """Write LANES consecutive elements of a float32 array."""

    def generate(context, builder, sig, args):
        store_unaligned(builder, args[2], pointer(context, builder, sig, args))
        return context.get_dummy_value()

    return types.none(array, index, vector), generate


def strided(stride: int):
    """`load_rows(array, index)` and `store_rows(array, index, vector)` for rows `stride` apart.

    A vector covers STRIP_ROWS rows of STRIP_COLUMNS elements, the first row in its lower lanes.
    """

    @intrinsic
    def load_rows(typing_context, array, index):
        def generate(context, builder, sig, args):
            rows = [
                load_unaligned(builder, pointer(context, builder, sig, args, step), _STRIP_ROW)
                for step in range(0, STRIP_ROWS * stride, stride)
            ]
            return shuffle(builder, rows[0], rows[-1], list(range(LANES)))

        return floats(array, index), generate

    @intrinsic
    def store_rows(typing_context, array, index, vector):
        def generate(context, builder, sig, args):
            for y in range(STRIP_ROWS):
                lanes = list(range(y * STRIP_COLUMNS, (y + 1) * STRIP_COLUMNS))
                row = shuffle(builder, args[2], args[2], lanes)
                store_unaligned(builder, row, pointer(context, builder, sig, args, y * stride))
            return context.get_dummy_value()

        return types.none(array, index, vector), generate

    return load_rows, store_rows


@intrinsic
def store_indices(typing_context, array, index, vector):
    """Write LANES consecutive elements of an integer array; the lanes hold whole numbers."""

    def generate(context, builder, sig, args):
        bits = ir.IntType(sig.args[0].dtype.bitwidth)
        kind = ir.VectorType(bits, LANES)
        wide = builder.fptosi(args[2], ir.VectorType(_INT32, LANES))
        whole = wide if bits.width == 32 else builder.trunc(wide, kind)
        store_unaligned(builder, whole, pointer(context, builder, sig, args))
        return context.get_dummy_value()

    return types.none(array, index, vector), generate


@intrinsic
def element(typing_context, array, index):
    """One element, without the code for negative indices."""

    def generate(context, builder, sig, args):
        return builder.load(pointer(context, builder, sig, args))

    return array.dtype(array, index), generate


@intrinsic
def fetch_add(typing_context, array, index, amount):
    """Add to an element atomically; gives its value before."""

    def generate(context, builder, sig, args):
        number = context.cast(builder, args[2], sig.args[2], sig.args[0].dtype)
        return builder.atomic_rmw("add", pointer(context, builder, sig, args), number, "monotonic")

    return array.dtype(array, index, amount), generate


def _prefetching(will_write: int):
    def generate(context, builder, sig, args):
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, _INT32, _INT32, _INT32])
        hint = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        address = builder.bitcast(pointer(context, builder, sig, args), byte)
        builder.call(hint, [address, _INT32(will_write), _INT32(3), _INT32(1)])
        return context.get_dummy_value()

    return generate


@intrinsic
def prefetch(typing_context, array, index):
    """Ask for the cache line of an element that will be read soon."""
    return types.none(array, index), _prefetching(0)


@intrinsic
def prefetch_to_write(typing_context, array, index):
    """Ask for the cache line of an element that will be written soon."""
    return types.none(array, index), _prefetching(1)
