"""Eight pixels of interleaved colour as three vectors, one per channel, and back."""

from __future__ import annotations

from numba.core import types

from services.mapping.rasterizer.memory import load, store
from services.mapping.rasterizer.simd import float8, inlined, intrinsic, shuffle

# Each channel (or vector of interleaved colour) by two shuffles: of the first two vectors, then of
# the result and the third; entries from 8 on are lanes of the second operand.
_SPLIT = (
    ([0, 3, 6, 9, 12, 15, 0, 0], [0, 1, 2, 3, 4, 5, 10, 13]),
    ([1, 4, 7, 10, 13, 0, 0, 0], [0, 1, 2, 3, 4, 8, 11, 14]),
    ([2, 5, 8, 11, 14, 0, 0, 0], [0, 1, 2, 3, 4, 9, 12, 15]),
)
_JOIN = (
    ([0, 8, 0, 1, 9, 0, 2, 10], [0, 1, 8, 3, 4, 9, 6, 7]),
    ([0, 3, 11, 0, 4, 12, 0, 5], [10, 1, 2, 11, 4, 5, 12, 7]),
    ([13, 0, 6, 14, 0, 7, 15, 0], [0, 13, 2, 3, 14, 5, 6, 15]),
)


def _rearranged(orders):
    """Code that gives three vectors from three."""

    def generate(context, builder, sig, args):
        vectors = [
            shuffle(builder, shuffle(builder, args[0], args[1], first), args[2], second)
            for first, second in orders
        ]
        return context.make_tuple(builder, sig.return_type, vectors)

    return generate


@intrinsic
def _split(typing_context, x, y, z):
    return types.UniTuple(float8, 3)(x, y, z), _rearranged(_SPLIT)


@intrinsic
def _join(typing_context, r, g, b):
    return types.UniTuple(float8, 3)(r, g, b), _rearranged(_JOIN)


@inlined
def load_colours(array, pixel):
    """Red, green and blue of 8 pixels from `pixel` on, array [P * 3]."""
    at = pixel * 3
    return _split(load(array, at), load(array, at + 8), load(array, at + 16))


@inlined
def store_colours(array, pixel, colours):
    """The reverse of `load_colours`."""
    x, y, z = _join(colours[0], colours[1], colours[2])
    store(array, pixel * 3, x)
    store(array, pixel * 3 + 8, y)
    store(array, pixel * 3 + 16, z)
