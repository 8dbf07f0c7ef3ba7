"""Frames as the gateway takes them, from arrays or from files' bytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.frames import ColourImage, DepthEncoding, DepthImage
from shared.images import encode_depth, encode_jpeg
from shared.se3 import Pose
from shared.stream import NO_KEYFRAME, DepthMessage, FrameMessage, PriorMessage

JPEG_QUALITY = 95


@dataclass(frozen=True)
class FrameOptions:
    """What may be said about a frame besides its images.

    `T_odom_camera`, [4, 4], is the device's own odometry in a smooth frame of its own.
    """

    may_be_keyframe: bool = True
    T_odom_camera: NDArray[np.float64] | None = None


def frame_message(
    seq: int,
    t_ns: int,
    rgb: NDArray[np.uint8] | ColourImage,
    depth: NDArray[np.uint16] | DepthImage,
    options: FrameOptions | None = None,
) -> FrameMessage:
    """One frame. Arrays (rgb [H, W, 3], depth raw [H, W]) are encoded as JPEG and 16 bit PNG."""
    options = options or FrameOptions()
    if not isinstance(rgb, ColourImage):
        rgb = encode_jpeg(np.asarray(rgb, np.uint8), JPEG_QUALITY)
    if not isinstance(depth, DepthImage):
        depth = encode_depth(np.asarray(depth, np.uint16), DepthEncoding.PNG16)
    T_odom = options.T_odom_camera
    return FrameMessage(
        seq=seq,
        t_ns=t_ns,
        rgb=rgb,
        depth=DepthMessage(depth.encoding, depth.bytes),
        prior=None if T_odom is None else PriorMessage(Pose.from_matrix(T_odom)),
        flags=() if options.may_be_keyframe else (NO_KEYFRAME,),
    )
