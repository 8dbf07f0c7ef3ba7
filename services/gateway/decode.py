"""What a client sent, checked before anything is decoded or allocated for it.

Only headers are read here: an image of another size than the calibration's is refused by its
header, so a small file that claims 60000x60000 pixels costs nothing. Trackers decode.
"""

from __future__ import annotations

import json
import struct
from contextlib import suppress
from typing import Any, TypeVar

import msgpack
import numpy as np
from numpy.typing import NDArray
from starlette.requests import Request

from services.gateway.errors import MESSAGE, TooLargeError
from shared import codec
from shared.camera import Calibration, Intrinsics
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding
from shared.se3 import Pose
from shared.stream import FLAGS, DepthMessage, FrameMessage

T = TypeVar("T")

UNKNOWN = -1  # seq and t_ns of a message that cannot be read
MAX_SEQ = 1 << 46  # a landmark's id is its keyframe's seq with 16 more bits
MAX_T_NS = 1 << 62
MAX_POSITION_M = 1e4  # points of a map are float32: a millimetre there
MAX_JSON_BYTES = 4 << 20  # the poses of a path render of two minutes have 1 MB
_ROOM = 1 << 16  # of a message, beyond its images
_MAX_FIELDS = 16
_TAIL = 64  # an image's end marker may be followed by so many bytes of padding
_PNG = b"\x89PNG\r\n\x1a\n"
_GREY, _RGB, _RGBA = 0, 2, 6
# Start-of-frame markers carry the size; C4, C8 and CC are tables that share the range.
_SOF = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def read_frame(data: bytes, calibration: Calibration) -> FrameMessage:
    """A checked frame from a msgpack message.

    Raises:
        TooLargeError: it is longer than its images could be without any compression. Other
            content would cost 70 times its size as Python values.
        InputError: names the field.
    """
    check_size_of(data, calibration)
    message = named_from(FrameMessage, codec.unpack, data)
    check_frame(message, calibration)
    return message


def read_numbers(data: bytes) -> tuple[int, int]:
    """`seq` and `t_ns` of a message that may be damaged elsewhere; UNKNOWN where unreadable.

    Everything else is skipped, so hostile content costs no Python values.
    """
    unpacker = msgpack.Unpacker(raw=False, max_array_len=len(FLAGS), max_map_len=_MAX_FIELDS)
    found = {"seq": UNKNOWN, "t_ns": UNKNOWN}
    with suppress(ValueError, TypeError, RecursionError, msgpack.UnpackException):
        unpacker.feed(data)
        for _ in range(unpacker.read_map_header()):
            key = unpacker.unpack()
            if key not in found:
                unpacker.skip()
            elif type(number := unpacker.unpack()) is int:
                found[key] = number
    return found["seq"], found["t_ns"]


def check_size_of(data: bytes, calibration: Calibration) -> None:
    """Refuse a message that is longer than its images could be, with a TooLargeError."""
    limit = _max_bytes(calibration)
    if len(data) > limit:
        raise TooLargeError(MESSAGE, f"must be at most {limit} bytes for this calibration")


def _max_bytes(calibration: Calibration) -> int:
    colour, depth = calibration.colour.intrinsics, calibration.depth_camera().intrinsics
    raw = 3 * colour.width * colour.height + 2 * depth.width * depth.height
    return raw + raw // 8 + _ROOM  # PNGs of noise are a little longer than its pixels


def plain(kind: type[T], value: Any) -> T:
    """A dataclass from JSON, with field names as the client wrote them."""
    return named_from(kind, codec.from_plain, value)


async def read_json(request: Request) -> Any:
    """A request's body.

    Raises:
        TooLargeError: it is longer than any of our requests. Parsing holds up everybody's frames:
            30 MB of nested lists take two seconds.
        InputError: it is no JSON.
    """
    body = await request.body()
    if len(body) > MAX_JSON_BYTES:
        raise TooLargeError(MESSAGE, f"must be at most {MAX_JSON_BYTES} bytes of JSON")
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise InputError(MESSAGE, f"not JSON ({str(error)[:200]})") from None


def named_from(kind: type[T], convert: Any, value: Any) -> T:
    """`convert(kind, value)` with errors that name the field without our class's name."""
    try:
        return convert(kind, value)
    except InputError as error:
        field = error.field.removeprefix(kind.__name__).lstrip(".")
        raise InputError(field or MESSAGE, error.reason) from None


def check_frame(message: FrameMessage, calibration: Calibration) -> None:
    """Refuse a frame whose fields or image headers do not fit the calibration.

    Raises:
        InputError: names the field, what was found and what would do.
    """
    _check_range("seq", message.seq, MAX_SEQ)
    _check_range("t_ns", message.t_ns, MAX_T_NS)
    for flag in message.flags:
        if flag not in FLAGS:
            raise InputError("flags", f"unknown flag {flag[:40]!r}; known: {', '.join(FLAGS)}")
    check_scale(message.depth, calibration)
    if message.prior is not None:
        matrix_of(message.prior.T_odom_camera, "prior.T_odom_camera")
    check_colour(message.rgb, calibration.colour.intrinsics)
    check_depth(message.depth, calibration.depth_camera().intrinsics)


def check_scale(depth: DepthMessage, calibration: Calibration) -> None:
    """Refuse depth in other units than the calibration's, with an InputError."""
    if depth.scale is not None and depth.scale != calibration.depth_scale:
        raise InputError(
            "depth.scale", f"is {depth.scale}, the calibration says {calibration.depth_scale}"
        )


def _check_range(field: str, value: int, limit: int) -> None:
    if not 0 <= value < limit:
        raise InputError(field, f"must be 0 to {limit - 1}, got {value}")


def matrix_of(pose: Pose, field: str) -> NDArray[np.float64]:
    """A client's pose as a matrix, [4, 4].

    Raises:
        InputError: it is no pose, or too far from the origin; names the field.
    """
    try:
        T = pose.matrix()
    except InputError as error:
        raise InputError(f"{field}.{error.field}", error.reason) from None
    if np.abs(T[:3, 3]).max() > MAX_POSITION_M:
        raise InputError(
            f"{field}.position", f"must be within {MAX_POSITION_M:.0f} m of the origin"
        )
    return T


def check_colour(image: ColourImage, size: Intrinsics) -> None:
    """Refuse a colour image by its header, with an InputError."""
    field, encoding, data = "rgb.bytes", image.encoding, image.bytes
    if encoding is ColourEncoding.RGB8:
        _check_length(data, 3 * size.width * size.height, field)
    elif encoding is ColourEncoding.JPEG:
        _check_jpeg(data, size, field)
    else:
        depth, colour = _check_png(data, size, field)
        if depth != 8 or colour not in (_GREY, _RGB, _RGBA):
            raise InputError(
                field, f"must be an 8 bit grey or RGB PNG, got {depth} bit of colour type {colour}"
            )


def check_depth(image: DepthMessage, size: Intrinsics) -> None:
    """Refuse a depth image by its header or length, with an InputError."""
    field, encoding, data = "depth.bytes", image.encoding, image.bytes
    rows = 2 * size.width * size.height
    if encoding is DepthEncoding.RAW16:
        _check_length(data, rows, field)
    elif encoding is DepthEncoding.ZLIB16:
        # zlib grows what it cannot pack by a few bytes in 16 kB.
        limit = rows + rows // 1000 + 64
        if not 8 <= len(data) <= limit:
            raise InputError(field, f"must be 8 to {limit} bytes of zlib, got {len(data)}")
    else:
        depth, colour = _check_png(data, size, field)
        if depth != 16 or colour != _GREY:
            raise InputError(
                field, f"must be a 16 bit grey PNG, got {depth} bit of colour type {colour}"
            )


def _check_length(data: bytes, expected: int, field: str) -> None:
    if len(data) != expected:
        raise InputError(field, f"must be {expected} bytes, got {len(data)}")


def _check_size(found: tuple[int, int], size: Intrinsics, field: str) -> None:
    if found != (size.width, size.height):
        raise InputError(
            field,
            f"is {found[0]}x{found[1]}, the calibration says {size.width}x{size.height}",
        )


def _check_png(data: bytes, size: Intrinsics, field: str) -> tuple[int, int]:
    """Bit depth and colour type of a PNG whose header has the right size."""
    if len(data) < 57 or not data.startswith(_PNG) or data[12:16] != b"IHDR":
        raise InputError(field, f"{len(data)} bytes that do not start as a PNG")
    width, height, depth, colour = struct.unpack(">IIBB", data[16:26])
    _check_size((width, height), size, field)
    if b"IEND" not in data[-_TAIL:]:
        raise InputError(field, f"a truncated PNG ({len(data)} bytes, no end chunk)")
    return depth, colour


def _check_jpeg(data: bytes, size: Intrinsics, field: str) -> None:
    if not data.startswith(b"\xff\xd8"):
        raise InputError(field, f"{len(data)} bytes that do not start as a JPEG")
    precision, height, width = _jpeg_frame(data, field)
    _check_size((width, height), size, field)
    if precision != 8:
        raise InputError(field, f"must be 8 bit, got {precision}")
    if b"\xff\xd9" not in data[-_TAIL:]:
        raise InputError(field, f"a truncated JPEG ({len(data)} bytes, no end marker)")


def _jpeg_frame(data: bytes, field: str) -> tuple[int, int, int]:
    """Precision, height and width from the start-of-frame segment."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _SOF:
            return struct.unpack(">BHH", data[at + 4 : at + 9])
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise InputError(field, f"a JPEG of {len(data)} bytes without a frame header")
