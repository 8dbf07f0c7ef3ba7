"""Messages of an MCAP file as our own values: Foxglove's protobuf schemas and ROS 2's."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.camera import Camera, Intrinsics
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage
from shared.se3 import Matrix, from_quat_xyzw

IMAGES = frozenset(
    {
        *("foxglove.RawImage", "foxglove.CompressedImage"),
        *("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    }
)
CALIBRATIONS = frozenset({"foxglove.CameraCalibration", "sensor_msgs/msg/CameraInfo"})
POSES = frozenset({"foxglove.PoseInFrame"})
FLOAT_DEPTH_SCALE = 4000.0  # units per metre that depth of 32FC1 is rounded to
_DEPTH = ("16UC1", "mono16", "32FC1")
_COMPRESSED_DEPTH_HEADER = 12  # bytes that ROS's compressedDepth puts before the PNG
_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
}
_NS = 1_000_000_000


@dataclass(frozen=True)
class ImageMessage:
    """An image as recorded; compressed ones have no size and say their format as encoding."""

    t_ns: int
    frame_id: str
    encoding: str
    data: bytes
    width: int = 0
    height: int = 0
    step: int = 0  # bytes of a row

    @property
    def is_depth(self) -> bool:
        """Whether it holds distances."""
        return self.encoding.startswith(_DEPTH) or "compressedDepth" in self.encoding


def image_message(schema: str, message: Any) -> ImageMessage:
    """An image of one of the schemas in `IMAGES`."""
    t_ns, frame_id = _header(schema, message)
    data = bytes(message.data)
    if schema.endswith("CompressedImage"):
        return ImageMessage(t_ns, frame_id, message.format, data)
    size = message.width, message.height, message.step
    return ImageMessage(t_ns, frame_id, message.encoding, data, *size)


def camera_of(schema: str, message: Any) -> tuple[str, Camera]:
    """The frame and the camera of one of the schemas in `CALIBRATIONS`."""
    ros = schema.startswith("sensor_msgs")
    fx, _, cx, _, fy, cy, *_ = message.k if ros else message.K
    distortion = tuple(float(k) for k in (message.d if ros else message.D))
    intrinsics = Intrinsics(fx, fy, cx, cy, message.width, message.height)
    fisheye = message.distortion_model in ("equidistant", "kannala_brandt", "fisheye")
    is_plain = not any(distortion)
    return _header(schema, message)[1], Camera(intrinsics, () if is_plain else distortion, fisheye)


def pose_of(message: Any) -> tuple[int, Matrix]:
    """Time and `T_world_camera` of a `foxglove.PoseInFrame`."""
    p, q = message.pose.position, message.pose.orientation
    t_ns = message.timestamp.seconds * _NS + message.timestamp.nanos
    return t_ns, from_quat_xyzw([q.x, q.y, q.z, q.w], [p.x, p.y, p.z])


def stamp_reader(schema: str, decode: Callable[[bytes], Any]) -> Callable[[bytes], int]:
    """What reads only the time of a message; of ROS's without decoding its pixels."""
    if schema.startswith("sensor_msgs"):
        return _cdr_stamp
    return lambda data: _header(schema, decode(data))[0]


def colour_image(message: ImageMessage) -> ColourImage:
    """The image as a client sends it; JPEG and PNG pass untouched.

    Raises:
        InputError: an encoding that we do not know.
    """
    if message.data.startswith(b"\xff\xd8"):
        return ColourImage(ColourEncoding.JPEG, message.data)
    if message.data.startswith(b"\x89PNG"):
        return ColourImage(ColourEncoding.PNG, message.data)
    if message.encoding == "rgb8":
        return ColourImage(ColourEncoding.RGB8, _rows(message, np.uint8, 3).tobytes())
    if message.encoding not in _TO_RGB:
        known = ", ".join(["jpeg", "png", "rgb8", *_TO_RGB])
        raise InputError("encoding", f"{message.encoding!r} is no colour we read; known: {known}")
    channels = {"bgr8": 3, "rgba8": 4, "bgra8": 4}.get(message.encoding, 1)
    rgb = cv2.cvtColor(_rows(message, np.uint8, channels), _TO_RGB[message.encoding])
    return ColourImage(ColourEncoding.RGB8, rgb.tobytes())


def depth_image(message: ImageMessage) -> DepthImage:
    """The image as a client sends it: as recorded, or metres times `FLOAT_DEPTH_SCALE`."""
    at = message.data.find(b"\x89PNG", 0, _COMPRESSED_DEPTH_HEADER + 4)
    if at >= 0:
        return DepthImage(DepthEncoding.PNG16, message.data[at:])
    if message.encoding in ("16UC1", "mono16"):
        return DepthImage(DepthEncoding.RAW16, _rows(message, np.uint16, 1).tobytes())
    if message.encoding != "32FC1":
        known = "16UC1, mono16, 32FC1, compressedDepth (PNG)"
        raise InputError("encoding", f"{message.encoding!r} is no depth we read; known: {known}")
    metres = np.nan_to_num(_rows(message, np.float32, 1), nan=0.0, posinf=0.0, neginf=0.0)
    units = np.rint(metres * FLOAT_DEPTH_SCALE)
    units[(units < 0) | (units >= 65535)] = 0
    return DepthImage(DepthEncoding.RAW16, units.astype("<u2").tobytes())


def _rows(message: ImageMessage, kind: type, channels: int) -> NDArray:
    """The pixels without what pads each row, [H, W] or [H, W, C]."""
    height, width, item = message.height, message.width, np.dtype(kind).newbyteorder("<")
    used = width * channels * item.itemsize
    if height * message.step != len(message.data) or used > message.step:
        size = f"{height} rows of {message.step} bytes with {width} pixels each"
        raise InputError("data", f"has {len(message.data)} bytes, which is not {size}")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, message.step)
    packed = np.ascontiguousarray(rows[:, :used]).view(item)
    return packed if channels == 1 else packed.reshape(height, width, channels)


def _header(schema: str, message: Any) -> tuple[int, str]:
    """Time and frame."""
    if schema.startswith("sensor_msgs"):
        stamp: SimpleNamespace = message.header.stamp
        return stamp.sec * _NS + stamp.nanosec, message.header.frame_id
    stamp = message.timestamp
    return stamp.seconds * _NS + stamp.nanos, message.frame_id


def _cdr_stamp(data: bytes) -> int:
    """Every message with a header starts with its stamp, after four bytes of encapsulation."""
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)
    return seconds * _NS + nanoseconds
