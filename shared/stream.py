"""What a client and the gateway say to each other on a frame stream (WebSocket, POST, gRPC).

The map frame is the world frame of the rest of the code: the camera of the session's first frame,
unless the client gave that frame a pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from shared.frames import ColourImage, DepthEncoding, DepthImage, Frame, TrackingStatus
from shared.se3 import Pose

NO_KEYFRAME = "no_keyframe"
FLAGS = (NO_KEYFRAME,)


@dataclass(frozen=True)
class DepthMessage:
    """Encoded depth; `scale` (units per metre) must repeat the calibration's where it is given."""

    encoding: DepthEncoding
    bytes: bytes
    scale: float | None = None


@dataclass(frozen=True)
class PriorMessage:
    """The device's own odometry: the camera in a smooth, drifting frame of its own."""

    T_odom_camera: Pose


@dataclass(frozen=True)
class FrameMessage:
    """One frame on the wire. Flags: `no_keyframe` (track it, never put it into the map).

    `traceparent` (W3C) makes its way through the services part of the client's trace.
    """

    seq: int
    t_ns: int
    rgb: ColourImage
    depth: DepthMessage
    prior: PriorMessage | None = None
    flags: tuple[str, ...] = ()
    traceparent: str = ""

    def frame(self) -> Frame:
        """The frame as the services pass it on."""
        return Frame(
            seq=self.seq,
            t_ns=self.t_ns,
            rgb=self.rgb,
            depth=DepthImage(self.depth.encoding, self.depth.bytes),
            T_odom_camera=self.prior.T_odom_camera if self.prior else None,
            may_be_keyframe=NO_KEYFRAME not in self.flags,
        )


@dataclass(frozen=True)
class ErrorDetail:
    """Why a frame was refused: the code of the error, the field at fault and what would do."""

    code: str
    field: str
    reason: str


@dataclass(frozen=True)
class FrameReply:
    """The answer to one frame: a pose and how good it is, or an error that says why not.

    `pos_std_m` and `rot_std_deg` are one standard deviation. `keyframe`: it is in the map and on
    disk; a live map's owner that takes long may take it later. `credit` is how many frames the
    client may send before the next reply. `map_problem` says why a live map does not grow at
    present (a full disk, no owner): poses go on, keyframes wait.
    """

    seq: int
    t_ns: int
    status: TrackingStatus | None = None
    T_map_camera: Pose | None = None
    pos_std_m: float | None = None
    rot_std_deg: float | None = None
    inliers: int = 0
    inlier_share: float = 0.0
    reference_seq: int = -1
    map_revision: int = 0
    keyframe: bool = False
    timings_ms: dict[str, float] = field(default_factory=dict)
    credit: int = 1
    error: ErrorDetail | None = None
    map_problem: ErrorDetail | None = None
