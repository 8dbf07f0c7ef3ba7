"""One image found in a map that exists: what is asked of a tracking worker, and its answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from shared.camera import Calibration, Camera
from shared.frames import ColourImage, DepthImage
from shared.se3 import Pose
from shared.stream import DepthMessage


class LocalizationStatus(StrEnum):
    """Whether an image was found, and by what."""

    LOCALISED = "LOCALISED"
    COLOUR_ONLY = "COLOUR_ONLY"  # by features alone: there was no depth to confirm it
    NOT_LOCALISED = "NOT_LOCALISED"


@dataclass(frozen=True)
class LocalizeRequest:
    """A query to one tracking worker: where in the map was this image taken? Nothing changes."""

    session: str
    epoch: int
    map_revision: int
    calibration: Calibration  # of the device that took the image
    rgb: ColourImage
    depth: DepthImage | None = None
    T_world_prior: NDArray[np.float64] | None = None  # [4, 4], where the camera is thought to be


@dataclass(frozen=True)
class LocalizeResult:
    """A worker's answer; the pose is the identity where the image was not found."""

    status: LocalizationStatus
    reason: str  # why it was not found, for people; else empty
    T_world_camera: NDArray[np.float64]  # [4, 4]
    covariance: NDArray[np.float64]  # [6, 6], of a twist (rho, phi) on the right of it
    inliers: int
    inlier_share: float
    reference_seq: int  # the keyframe that it was found by; -1 where there is none
    map_revision: int
    timings_ms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class LocalizeMessage:
    """The question as clients send it (HTTP, gRPC).

    The image is of the session's device, unless it comes with the `calibration` of another RGB-D
    device, or without depth and with the `camera` that took it.
    """

    rgb: ColourImage
    depth: DepthMessage | None = None
    T_map_camera_prior: Pose | None = None
    calibration: Calibration | None = None
    camera: Camera | None = None


@dataclass(frozen=True)
class LocalizeReply:
    """The answer as clients get it: a pose and how good it is, or the reason why there is none.

    `pos_std_m` and `rot_std_deg` are one standard deviation; `covariance` has the 6x6 numbers of a
    twist (rho, phi: metres, radians) on the right of the pose, in the camera frame, row by row.
    """

    status: LocalizationStatus
    reason: str
    T_map_camera: Pose | None
    pos_std_m: float | None
    rot_std_deg: float | None
    covariance: tuple[float, ...]
    inliers: int
    inlier_share: float
    reference_seq: int
    map_revision: int
    timings_ms: dict[str, float] = field(default_factory=dict)
