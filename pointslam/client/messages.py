"""Frames as the gateway takes them, from arrays or from files' bytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.camera import Calibration, Camera
from shared.frames import ColourImage, DepthEncoding, DepthImage
from shared.images import encode_depth, encode_jpeg
from shared.localization import LocalizeMessage
from shared.se3 import Pose
from shared.stream import NO_KEYFRAME, DepthMessage, FrameMessage, PriorMessage

JPEG_QUALITY = 95


@dataclass(frozen=True)
class FrameOptions:
    """What may be said about a frame besides its images.

    `T_odom_camera`, [4, 4], is the device's own odometry in a smooth frame of its own;
    `traceparent` (W3C) makes the frame part of a trace.
    """

    may_be_keyframe: bool = True
    T_odom_camera: NDArray[np.float64] | None = None
    traceparent: str = ""


def frame_message(
    seq: int,
    t_ns: int,
    rgb: NDArray[np.uint8] | ColourImage,
    depth: NDArray[np.uint16] | DepthImage,
    options: FrameOptions | None = None,
) -> FrameMessage:
    """One frame. Arrays (rgb [H, W, 3], depth raw [H, W]) are encoded as JPEG and 16 bit PNG."""
    options = options or FrameOptions()
    T_odom = options.T_odom_camera
    return FrameMessage(
        seq=seq,
        t_ns=t_ns,
        rgb=_colour(rgb),
        depth=_depth(depth),
        prior=None if T_odom is None else PriorMessage(Pose.from_matrix(T_odom)),
        flags=() if options.may_be_keyframe else (NO_KEYFRAME,),
        traceparent=options.traceparent,
    )


def localize_message(
    rgb: NDArray[np.uint8] | ColourImage,
    depth: NDArray[np.uint16] | DepthImage | None,
    device: Calibration | Camera | None,
    T_map_camera_prior: NDArray[np.float64] | None,
) -> LocalizeMessage:
    """A single image to be found in a map, of the session's device where none is given."""
    T_prior = T_map_camera_prior
    return LocalizeMessage(
        rgb=_colour(rgb),
        depth=None if depth is None else _depth(depth),
        T_map_camera_prior=None if T_prior is None else Pose.from_matrix(T_prior),
        calibration=device if isinstance(device, Calibration) else None,
        camera=device if isinstance(device, Camera) else None,
    )


def _colour(rgb: NDArray[np.uint8] | ColourImage) -> ColourImage:
    if isinstance(rgb, ColourImage):
        return rgb
    return encode_jpeg(np.asarray(rgb, np.uint8), JPEG_QUALITY)


def _depth(depth: NDArray[np.uint16] | DepthImage) -> DepthMessage:
    if not isinstance(depth, DepthImage):
        depth = encode_depth(np.asarray(depth, np.uint16), DepthEncoding.PNG16)
    return DepthMessage(depth.encoding, depth.bytes)
