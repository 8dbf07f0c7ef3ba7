"""Frames as clients send them, and what the gateway knows when it hands one to a tracker."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shared.camera import Calibration
from shared.se3 import Pose


class ColourEncoding(StrEnum):
    """How a colour image is written."""

    JPEG = "jpeg"
    PNG = "png"
    RGB8 = "rgb8"  # raw rows, 3 bytes a pixel


class DepthEncoding(StrEnum):
    """How a depth image is written; values are uint16, 0 and 65535 mean no reading."""

    PNG16 = "png16"
    RAW16 = "raw16"  # raw rows, little endian
    ZLIB16 = "zlib16"  # raw16 through zlib


@dataclass(frozen=True)
class ColourImage:
    """An encoded colour image of the calibration's size."""

    encoding: ColourEncoding
    bytes: bytes


@dataclass(frozen=True)
class DepthImage:
    """An encoded depth image of the calibration's depth camera's size."""

    encoding: DepthEncoding
    bytes: bytes


@dataclass(frozen=True)
class Frame:
    """One RGB-D frame of a session: the wire's `frame` message.

    `seq` grows by at least one from frame to frame, `t_ns` is the client's clock and grows too.
    `T_odom_camera` is the device's own odometry, where it has one. A frame that may not become a
    keyframe is tracked and answered, but never enters the map (held out for evaluation).
    """

    seq: int
    t_ns: int
    rgb: ColourImage
    depth: DepthImage
    T_odom_camera: Pose | None = None
    may_be_keyframe: bool = True

    def digest(self) -> int:
        """CRC-32 of both images: a frame that has that of the one before it is a repeat."""
        return self._digest

    @cached_property
    def _digest(self) -> int:
        return zlib.crc32(self.depth.bytes, zlib.crc32(self.rgb.bytes))


class TrackingStatus(StrEnum):
    """How a frame was answered."""

    TRACKED = "TRACKED"
    COARSE_ONLY = "COARSE_ONLY"  # by geometry or by features alone; the other could not confirm it
    RELOCALISED = "RELOCALISED"
    LOST = "LOST"
    SUPERSEDED = "SUPERSEDED"  # live mode: a newer frame came while this one waited
    NEED_FRAMES = "NEED_FRAMES"  # the map is too young to answer


HAS_POSE = (TrackingStatus.TRACKED, TrackingStatus.COARSE_ONLY, TrackingStatus.RELOCALISED)


@dataclass(frozen=True)
class Prior:
    """What is known of the camera before a frame is tracked; all that tracking remembers.

    `seq` and `t_ns` are of the last frame with a pose; `T_before_last` is its motion: it maps
    points of the last camera to the camera of the frame with a pose before it (identity at first).
    Of an image that was sent more than once, time, odometry and motion are of the first time.
    """

    seq: int
    t_ns: int
    T_world_camera: NDArray[np.float64]  # [4, 4]
    T_before_last: NDArray[np.float64]  # [4, 4]
    before_last_dt_ns: int
    reference_seq: int  # the keyframe that the pose was told relative to
    newest_keyframe_seq: int
    lost_frames: int  # frames without a pose since then
    frames_since_keyframe: int
    T_odom_camera: Pose | None = None
    frame_digest: int | None = None  # of that frame
    T_reference_camera: NDArray[np.float64] | None = None  # [4, 4], holds when the map moves


@dataclass(frozen=True)
class TrackRequest:
    """A query to one tracking worker."""

    session: str
    epoch: int
    map_revision: int
    calibration: Calibration
    frame: Frame
    prior: Prior | None  # None: no frame of this session has a pose yet
    T_world_first: NDArray[np.float64]  # [4, 4], pose of the session's first frame
    accepts_older_map: bool = False  # live: where the map's owner is absent, what is cached will do
