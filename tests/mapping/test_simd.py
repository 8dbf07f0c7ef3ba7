"""The SIMD type against numpy, lane by lane."""

import numpy as np
import pytest

from services.mapping.rasterizer.lanes import (
    all_lanes,
    any_lane,
    ceil_index,
    floor_index,
    lane,
)
from services.mapping.rasterizer.memory import (
    element,
    fetch_add,
    load,
    prefetch,
    prefetch_to_write,
    store,
    store_indices,
    strided,
)
from services.mapping.rasterizer.places import (
    ramp,
    round_down,
    round_up,
    split_exponent,
    strip_columns,
    strip_rows,
)
from services.mapping.rasterizer.shuffles import (
    RECORD,
    load_four,
    load_records,
    load_three,
    store_four,
    store_lane_sums,
    store_records,
    store_three,
)
from services.mapping.rasterizer.simd import (
    LANES,
    STRIP_COLUMNS,
    STRIP_ROWS,
    kernel,
    magnitude,
    maximum,
    minimum,
    negative_magnitude,
    select,
    splat,
    square_root,
)

X = np.resize(np.array([1.5, -2.0, 0.25, 8.0, -0.5, 3.0, 100.0, 7.0], np.float32), LANES)
Y = np.resize(np.array([0.5, 4.0, -1.0, 8.0, 2.0, -3.0, 0.125, 9.0], np.float32), LANES)


@kernel
def _arithmetic(x, y, out):
    a, b = load(x, 0), load(y, 0)
    store(out, 0, a + b)
    store(out, LANES, a - b)
    store(out, 2 * LANES, a * b)
    store(out, 3 * LANES, a / b)
    store(out, 4 * LANES, 2.0 * a + 1)
    store(out, 5 * LANES, 3 - a)


@kernel
def _choose(x, y, out):
    a, b = load(x, 0), load(y, 0)
    store(out, 0, select(a < b, a, b))
    store(out, LANES, select((a >= b) & (b > 0.0), 1.0, splat(np.float32(0.0))))
    store(out, 2 * LANES, select(a <= 1.5, ramp(), -1.0))
    store(out, 3 * LANES, minimum(a, b))
    store(out, 4 * LANES, maximum(a, b))
    store(out, 5 * LANES, negative_magnitude(a))
    store(out, 6 * LANES, square_root(a * a))
    store(out, 7 * LANES, magnitude(a))


@kernel
def _sum_rows(rows, out):
    a, b, c = load(rows, 0), load(rows, LANES), load(rows, 2 * LANES)
    store_lane_sums(out, 0, (a, b, c, a, a, a, a, a, b, c))


@kernel
def _copy_fields(threes, fours, out):
    store_three(out, 0, load_three(threes, 0))
    store_four(out, 3 * LANES, load_four(fours, 0))


@kernel
def _split_fields(threes, out):
    x, y, z = load_three(threes, 0)
    store(out, 0, x)
    store(out, LANES, y)
    store(out, 2 * LANES, z)


@kernel
def _copy_records(source, target):
    numbers = load_records(source, 0)
    store(target, 0, numbers[1])
    store_records(target, LANES, numbers)


_LOAD_ROWS, _STORE_ROWS = strided(20)


@kernel
def _copy_rows(source, target):
    _STORE_ROWS(target, 3, _LOAD_ROWS(source, 5))
    store(target, 80, strip_columns())
    store(target, 80 + LANES, strip_rows())


@kernel
def _split(x, out, whole):
    exponent, mantissa = split_exponent(load(x, 0))
    store(out, 0, exponent)
    store(out, LANES, mantissa)
    store_indices(whole, 0, round_down(load(x, 0)))
    store_indices(whole, LANES, round_up(load(x, 0)))


@kernel
def _are_all_above(x, limit):
    return all_lanes(load(x, 0) > limit)


@kernel
def _numbers(x, whole):
    prefetch(x, 7)
    prefetch_to_write(whole, 0)
    whole[0] = ceil_index(element(x, 0))
    whole[1] = floor_index(element(x, 1))
    whole[2] = fetch_add(whole, 4, 5)
    whole[3] = any_lane(load(x, 0) > 99.0)
    return lane(load(x, 0), 3)


@kernel
def _is_any_above(x, limit):
    return any_lane(load(x, 0) > limit)


@kernel
def _copy(source, target, index):
    store(target, index, load(source, index))


def test_arithmetic_works_lane_by_lane_and_with_numbers_on_either_side():
    out = np.empty(6 * LANES, np.float32)

    _arithmetic(X, Y, out)

    np.testing.assert_allclose(
        out.reshape(6, LANES), [X + Y, X - Y, X * Y, X / Y, 2 * X + 1, 3 - X], rtol=1e-6
    )


def test_comparisons_and_selections_follow_numpy():
    out = np.empty(8 * LANES, np.float32)

    _choose(X, Y, out)

    expected = [
        np.minimum(X, Y),
        (X >= Y) & (Y > 0),
        np.where(X <= 1.5, np.arange(LANES), -1),
        np.minimum(X, Y),
        np.maximum(X, Y),
        -np.abs(X),
        np.abs(X),
        np.abs(X),
    ]
    np.testing.assert_array_equal(out.reshape(8, LANES), expected)


def test_lane_sums_keep_the_order_of_their_vectors():
    rows = np.arange(3 * LANES, dtype=np.float32).reshape(3, LANES) ** 2
    out = np.empty(RECORD, np.float32)

    _sum_rows(rows.reshape(-1), out)

    np.testing.assert_array_equal(out[:10], rows.sum(1)[[0, 1, 2, 0, 0, 0, 0, 0, 1, 2]])


def test_interleaved_fields_come_back_in_place():
    threes, fours = np.arange(3.0 * LANES), -np.arange(4.0 * LANES)
    out, split = np.empty(7 * LANES, np.float32), np.empty(3 * LANES, np.float32)

    _copy_fields(threes.astype(np.float32), fours.astype(np.float32), out)
    _split_fields(threes.astype(np.float32), split)

    np.testing.assert_array_equal(out, np.concatenate([threes, fours]))
    np.testing.assert_array_equal(split.reshape(3, LANES), threes.reshape(LANES, 3).T)


def test_records_are_transposed_and_back():
    source = np.arange(RECORD * LANES, dtype=np.float32)
    target = np.empty(RECORD * LANES + LANES, np.float32)

    _copy_records(source, target)

    np.testing.assert_array_equal(target[:LANES], source.reshape(LANES, RECORD)[:, 1])
    np.testing.assert_array_equal(target[LANES:], source)


def test_a_vector_covers_rows_of_a_strip():
    source, target = np.arange(80, dtype=np.float32), np.zeros(80 + 2 * LANES, np.float32)

    _copy_rows(source, target)

    expected = np.zeros(80, np.float32)
    for row in range(STRIP_ROWS):
        expected[3 + 20 * row :][:STRIP_COLUMNS] = source[5 + 20 * row :][:STRIP_COLUMNS]
    np.testing.assert_array_equal(target[:80], expected)
    np.testing.assert_array_equal(target[80 : 80 + LANES], np.arange(LANES) % STRIP_COLUMNS)
    np.testing.assert_array_equal(target[80 + LANES :], np.arange(LANES) // STRIP_COLUMNS)


def test_numbers_split_into_exponent_and_mantissa_and_round_to_indices():
    x = np.linspace(0.01, 99.0, LANES).astype(np.float32)
    out, whole = np.empty(2 * LANES, np.float32), np.empty(2 * LANES, np.int16)

    _split(x, out, whole)

    exponent, mantissa = out.reshape(2, LANES)
    np.testing.assert_array_equal(2.0**exponent * mantissa, x)
    assert ((mantissa > 0.707) & (mantissa < 1.4143)).all()
    np.testing.assert_array_equal(whole.reshape(2, LANES), [np.floor(x), np.ceil(x)])


@pytest.mark.parametrize(("limit", "expected"), [(-3.0, True), (-2.0, False)])
def test_all_lanes_tells_whether_every_one_holds(limit, expected):
    assert _are_all_above(X, np.float32(limit)) == expected


def test_numbers_round_toward_the_named_side_and_counters_give_the_old_value():
    whole = np.array([0, 0, 0, 0, 37], np.int64)

    fourth = _numbers(np.where(X == -2.0, np.float32(-2.5), X), whole)

    assert whole.tolist() == [2, -3, 37, 1, 42]
    assert fourth == 8.0


@pytest.mark.parametrize(("limit", "expected"), [(99.0, True), (100.0, False)])
def test_any_lane_tells_whether_one_holds(limit, expected):
    assert _is_any_above(X, np.float32(limit)) == expected


def test_nan_fails_every_comparison():
    x = np.full(LANES, np.nan, np.float32)

    assert not _is_any_above(x, np.float32(-np.inf))


@pytest.mark.parametrize("index", [0, 1, 5])
def test_loads_and_stores_need_no_alignment(index):
    source, target = np.arange(3.0 * LANES).astype(np.float32), np.zeros(3 * LANES, np.float32)

    _copy(source, target, index)

    copied = slice(index, index + LANES)
    np.testing.assert_array_equal(target[copied], source[copied])
    assert target.sum() == source[copied].sum()
