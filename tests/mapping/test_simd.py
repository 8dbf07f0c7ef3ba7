"""The SIMD type against numpy, lane by lane."""

import numpy as np
import pytest

from services.mapping.rasterizer.lanes import (
    any_lane,
    ceil_index,
    floor_index,
    lane,
    lane_sums,
    lane_sums_of_two,
)
from services.mapping.rasterizer.memory import element, fetch_add, load, prefetch, store
from services.mapping.rasterizer.simd import (
    kernel,
    maximum,
    minimum,
    negative_magnitude,
    ramp,
    select,
    splat,
    square_root,
)

X = np.array([1.5, -2.0, 0.25, 8.0, -0.5, 3.0, 100.0, 7.0], np.float32)
Y = np.array([0.5, 4.0, -1.0, 8.0, 2.0, -3.0, 0.125, 9.0], np.float32)


@kernel
def _arithmetic(x, y, out):
    a, b = load(x, 0), load(y, 0)
    store(out, 0, a + b)
    store(out, 8, a - b)
    store(out, 16, a * b)
    store(out, 24, a / b)
    store(out, 32, 2.0 * a + 1)
    store(out, 40, 3 - a)


@kernel
def _choose(x, y, out):
    a, b = load(x, 0), load(y, 0)
    store(out, 0, select(a < b, a, b))
    store(out, 8, select((a >= b) & (b > 0.0), 1.0, splat(np.float32(0.0))))
    store(out, 16, select(a <= 1.5, ramp(), -1.0))
    store(out, 24, minimum(a, b))
    store(out, 32, maximum(a, b))
    store(out, 40, negative_magnitude(a))
    store(out, 48, square_root(a * a))


@kernel
def _sum_rows(rows, out):
    a, b, c, d = load(rows, 0), load(rows, 8), load(rows, 16), load(rows, 24)
    e, f, g, h = load(rows, 32), load(rows, 40), load(rows, 48), load(rows, 56)
    store(out, 0, lane_sums(a, b, c, d, e, f, g, h))
    store(out, 8, lane_sums_of_two(a, b))


@kernel
def _numbers(x, whole):
    prefetch(x, 7)
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
    out = np.empty(48, np.float32)

    _arithmetic(X, Y, out)

    np.testing.assert_allclose(
        out.reshape(6, 8), [X + Y, X - Y, X * Y, X / Y, 2 * X + 1, 3 - X], rtol=1e-6
    )


def test_comparisons_and_selections_follow_numpy():
    out = np.empty(56, np.float32)

    _choose(X, Y, out)

    expected = [
        np.minimum(X, Y),
        (X >= Y) & (Y > 0),
        np.where(X <= 1.5, np.arange(8), -1),
        np.minimum(X, Y),
        np.maximum(X, Y),
        -np.abs(X),
        np.abs(X),
    ]
    np.testing.assert_array_equal(out.reshape(7, 8), expected)


def test_horizontal_sums_keep_the_order_of_their_vectors():
    rows = np.arange(64, dtype=np.float32).reshape(8, 8) ** 2
    out = np.empty(16, np.float32)

    _sum_rows(rows.reshape(-1), out)

    np.testing.assert_array_equal(out[:8], rows.sum(1))
    np.testing.assert_array_equal(out[8:10], rows.sum(1)[:2])


def test_numbers_round_toward_the_named_side_and_counters_give_the_old_value():
    whole = np.array([0, 0, 0, 0, 37], np.int64)

    fourth = _numbers(np.where(X == -2.0, np.float32(-2.5), X), whole)

    assert whole.tolist() == [2, -3, 37, 1, 42]
    assert fourth == 8.0


@pytest.mark.parametrize(("limit", "expected"), [(99.0, True), (100.0, False)])
def test_any_lane_tells_whether_one_holds(limit, expected):
    assert _is_any_above(X, np.float32(limit)) == expected


def test_nan_fails_every_comparison():
    x = np.full(8, np.nan, np.float32)

    assert not _is_any_above(x, np.float32(-np.inf))


@pytest.mark.parametrize("index", [0, 1, 5])
def test_loads_and_stores_need_no_alignment(index):
    source, target = np.arange(16, dtype=np.float32), np.zeros(16, np.float32)

    _copy(source, target, index)

    np.testing.assert_array_equal(target[index : index + 8], source[index : index + 8])
    assert target.sum() == source[index : index + 8].sum()
