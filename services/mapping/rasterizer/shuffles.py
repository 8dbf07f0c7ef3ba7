"""Between memory order and lane order: interleaved fields, transposed records, lane sums.

`LANES` structures side by side in memory become one vector per field and back. All is done in
registers by two-operand shuffles.
"""

from __future__ import annotations

from numba.core import cgutils, types

from services.mapping.rasterizer.memory import load_unaligned, pointer, store_unaligned
from services.mapping.rasterizer.simd import FAST_MATH, LANES, floats, intrinsic, shuffle

RECORD = 16  # float32 numbers in a record: one cache line


def _gathered(builder, vectors: list, sources: list[int]):
    """The vector whose lanes are those `sources` of the concatenated vectors."""
    result = vectors[0]
    for part, vector in enumerate(vectors):
        inside = [source // LANES == part for source in sources]
        order = [
            LANES + source % LANES if here else lane
            for lane, (source, here) in enumerate(zip(sources, inside, strict=True))
        ]
        if any(inside):
            # Lanes that a later part fills hold whatever the first vector has there.
            result = shuffle(builder, result, vector, order)
    return result


def _fields(count: int):
    """`load_fields` and `store_fields` for structures of `count` numbers."""

    @intrinsic
    def load_fields(typing_context, array, index):
        def generate(context, builder, sig, args):
            parts = [
                load_unaligned(builder, pointer(context, builder, sig, args, k * LANES))
                for k in range(count)
            ]
            fields = [
                _gathered(builder, parts, [lane * count + k for lane in range(LANES)])
                for k in range(count)
            ]
            return context.make_tuple(builder, sig.return_type, fields)

        return types.UniTuple(floats, count)(array, index), generate

    @intrinsic
    def store_fields(typing_context, array, index, fields):
        def generate(context, builder, sig, args):
            vectors = cgutils.unpack_tuple(builder, args[2], count)
            for part in range(count):
                places = range(part * LANES, (part + 1) * LANES)
                sources = [place % count * LANES + place // count for place in places]
                address = pointer(context, builder, sig, args, part * LANES)
                store_unaligned(builder, _gathered(builder, vectors, sources), address)
            return context.get_dummy_value()

        return types.none(array, index, fields), generate

    return load_fields, store_fields


# Structures of three and of four numbers.
load_three, store_three = _fields(3)
load_four, store_four = _fields(4)


def _transposed(builder, rows: list) -> list:
    """The transpose of LANES vectors: at each step, swap off-diagonal blocks of half the size."""
    size = LANES // 2
    while size:
        lanes = range(LANES)
        upper = [LANES + lane - size if lane & size else lane for lane in lanes]
        lower = [LANES + lane if lane & size else lane + size for lane in lanes]
        for i in lanes:
            if not i & size:
                a, b = rows[i], rows[i + size]
                rows[i], rows[i + size] = (
                    shuffle(builder, a, b, upper),
                    shuffle(builder, a, b, lower),
                )
        size //= 2
    return rows


@intrinsic
def load_records(typing_context, array, index):
    """LANES records side by side, as one vector per number of a record."""

    def generate(context, builder, sig, args):
        numbers = []
        for part in range(0, RECORD, LANES):
            rows = [
                load_unaligned(builder, pointer(context, builder, sig, args, lane * RECORD + part))
                for lane in range(LANES)
            ]
            numbers += _transposed(builder, rows)
        return context.make_tuple(builder, sig.return_type, numbers)

    return types.UniTuple(floats, RECORD)(array, index), generate


@intrinsic
def store_records(typing_context, array, index, numbers):
    """Write LANES records side by side from one vector per number of a record."""

    def generate(context, builder, sig, args):
        vectors = cgutils.unpack_tuple(builder, args[2], RECORD)
        for part in range(0, RECORD, LANES):
            for lane, row in enumerate(_transposed(builder, vectors[part : part + LANES])):
                address = pointer(context, builder, sig, args, lane * RECORD + part)
                store_unaligned(builder, row, address)
        return context.get_dummy_value()

    return types.none(array, index, numbers), generate


def _sum_step(builder, x, y, width: int):
    """Fold sums that have `width` partial terms each in x and in y to half as many terms."""
    starts = range(0, LANES, width)
    low = [start + term for start in starts for term in range(width // 2)]
    order = low + [LANES + lane for lane in low]
    half = [lane + width // 2 for lane in order]
    return builder.fadd(
        shuffle(builder, x, y, order), shuffle(builder, x, y, half), flags=FAST_MATH
    )


def _lane_sums(builder, vectors: list):
    """The horizontal sums of up to LANES vectors, as one vector."""
    width = LANES
    while width > 1:
        seconds = vectors[1::2] + vectors[-1:]
        vectors = [
            _sum_step(builder, x, y, width) for x, y in zip(vectors[::2], seconds, strict=False)
        ]
        width //= 2
    return vectors[0]


@intrinsic
def lane_sums(typing_context, vectors):
    """The horizontal sums of a tuple of up to LANES vectors, in its order; 8 of them or more."""

    def generate(context, builder, sig, args):
        return _lane_sums(builder, cgutils.unpack_tuple(builder, args[0], sig.args[0].count))

    return floats(vectors), generate


@intrinsic
def store_lane_sums(typing_context, array, index, vectors):
    """Write the horizontal sum of each vector of a tuple to a record; the rest is arbitrary."""

    def generate(context, builder, sig, args):
        parts = cgutils.unpack_tuple(builder, args[2], sig.args[2].count)
        for part in range(0, RECORD, LANES):
            sums = _lane_sums(builder, parts[part : part + LANES])
            address = pointer(context, builder, sig, args, part)
            store_unaligned(builder, sums, address)
        return context.get_dummy_value()

    return types.none(array, index, vectors), generate
