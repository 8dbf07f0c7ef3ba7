"""The wire: what is packed comes back, and nothing else gets in."""

from dataclasses import dataclass, field

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from shared import codec
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, TrackingStatus
from shared.stream import DepthMessage, FrameMessage, FrameReply


@dataclass(frozen=True)
class Inner:
    text: str
    numbers: tuple[float, ...] = ()


@dataclass(frozen=True)
class Outer:
    count: int
    inner: Inner
    points: NDArray[np.float32]
    status: TrackingStatus = TrackingStatus.LOST
    maybe: Inner | None = None
    times: dict[str, float] = field(default_factory=dict)


def packb(plain):
    data = msgpack.packb(plain)
    assert data is not None
    return data


def example(points):
    return Outer(3, Inner("a", (1.0, 2.5)), points, TrackingStatus.TRACKED, None, {"x": 1.0})


@given(arrays.arrays(np.float32, arrays.array_shapes(max_dims=4), elements=st.floats(width=32)))
def test_what_is_packed_comes_back(points):
    back = codec.unpack(Outer, codec.pack(example(points)))

    np.testing.assert_array_equal(back.points, points)
    assert (back.count, back.inner, back.status, back.times) == (
        3,
        Inner("a", (1.0, 2.5)),
        TrackingStatus.TRACKED,
        {"x": 1.0},
    )


def test_only_fields_are_packed():
    frame = FrameMessage(
        1, 2, ColourImage(ColourEncoding.RGB8, b"rgb"), DepthMessage(DepthEncoding.RAW16, b"d")
    ).frame()
    before = codec.pack(frame)

    frame.digest()  # is kept in the frame from here on

    assert codec.pack(frame) == before


def test_an_array_that_is_a_view_is_packed_as_it_reads():
    points = np.arange(12, dtype=np.float32).reshape(3, 4).T[::2]

    back = codec.unpack(Outer, codec.pack(example(points)))

    np.testing.assert_array_equal(back.points, points)


def test_json_carries_arrays_as_lists():
    plain = codec.to_json(example(np.array([[1, 2]], np.float32)))

    assert plain["points"] == [[1.0, 2.0]]
    np.testing.assert_array_equal(codec.from_plain(Outer, plain).points, [[1, 2]])


def packed(**changes):
    plain = codec.to_plain(example(np.zeros(2, np.float32))) | changes
    plain["points"] = [0.0]
    plain |= {"points": changes["points"]} if "points" in changes else {}
    return packb({key: value for key, value in plain.items() if value is not ...})


@pytest.mark.parametrize(
    ("changes", "field", "reason"),
    [
        ({"count": ...}, "Outer.count", "is missing"),
        ({"count": "3"}, "Outer.count", "must be int"),
        ({"count": True}, "Outer.count", "must be int"),
        ({"count": None}, "Outer.count", "got nothing"),
        ({"extra": 1}, "Outer.extra", "unknown field"),
        ({"inner": [1]}, "Outer.inner", "map of fields"),
        ({"inner": {"text": b"x"}}, "Outer.inner.text", "must be str"),
        ({"inner": {"text": "x", "numbers": ["y"]}}, "Outer.inner.numbers[0]", "float"),
        ({"status": "FLYING"}, "Outer.status", "must be one of"),
        ({"times": {"x": "fast"}}, "Outer.times.x", "float"),
        ({"points": [[1.0], [1.0, 2.0]]}, "Outer.points", "equal length"),
        ({"points": "abc"}, "Outer.points", "must be an array"),
    ],
)
def test_a_field_that_does_not_fit_is_named(changes, field, reason):
    with pytest.raises(InputError, match=reason) as caught:
        codec.unpack(Outer, packed(**changes))

    assert caught.value.field == field


def test_a_number_beyond_every_float_is_named():
    plain = codec.to_json(example(np.zeros(2, np.float32))) | {"times": {"x": 10**400}}

    with pytest.raises(InputError, match="too large") as caught:
        codec.from_plain(Outer, plain)

    assert caught.value.field == "Outer.times.x"


def array_bytes(dtype, shape, data):
    return packb(
        {
            "count": 1,
            "inner": {"text": ""},
            "points": msgpack.ExtType(1, packb([dtype, shape]) + data),
        }
    )


@pytest.mark.parametrize(
    ("dtype", "shape", "data"),
    [
        ("<f4", [2], bytes(4)),
        ("<f4", [1 << 40], bytes(4)),
        ("<f4", [-1], bytes(4)),
        ("<f4", [1] * 9, bytes(4)),
        ("|O", [1], bytes(8)),
        ("<f4", 3, bytes(12)),
        ("<f4", ["a"], bytes(4)),
    ],
)
def test_an_array_that_lies_about_itself_is_refused(dtype, shape, data):
    with pytest.raises(InputError):
        codec.unpack(Outer, array_bytes(dtype, shape, data))


def test_an_array_of_another_type_is_refused():
    data = codec.pack(example(np.zeros(2, np.float64)))

    with pytest.raises(InputError, match="array of float32, got float64"):
        codec.unpack(Outer, data)


def test_an_unknown_extension_is_refused():
    with pytest.raises(InputError, match="extension type 9"):
        codec.unpack(Outer, packb(msgpack.ExtType(9, b"x")))


@given(st.binary(max_size=200))
def test_random_bytes_never_do_more_than_raise_our_error(data):
    try:
        codec.unpack(FrameMessage, data)
    except InputError:
        return
    raise AssertionError("random bytes became a frame")


@given(st.data())
def test_a_damaged_frame_never_does_more_than_raise_our_error(data):
    depth = DepthMessage("raw16", b"12")  # type: ignore[arg-type]
    message = FrameMessage(1, 2, ColourImage(ColourEncoding.JPEG, b"123"), depth)
    raw = bytearray(codec.pack(message))
    raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))

    try:
        codec.unpack(FrameMessage, bytes(raw))
    except InputError:
        return


def test_a_reply_without_a_pose_comes_back_without():
    reply = codec.unpack(FrameReply, codec.pack(FrameReply(1, 2)))

    assert reply == FrameReply(1, 2)
