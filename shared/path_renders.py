"""Views along a path of cameras, drawn one after the other into one file."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from shared.camera import Intrinsics
from shared.maps import JobState
from shared.se3 import Pose, Vector3


class PathKind(StrEnum):
    """Where the camera goes."""

    TRAJECTORY = "trajectory"  # where the device was, at its own pace, in the map as it is now
    KEYFRAMES = "keyframes"  # smoothly past some of the keyframes
    POSES = "poses"  # smoothly through given poses; as many frames as poses are these exactly
    ORBIT = "orbit"  # around a point, from a first view


class PathFormat(StrEnum):
    """What the views are written as."""

    WEBM = "webm"  # VP8: quick to write, played by every browser
    MP4 = "mp4"  # VP9: takes four times as long to write
    JPEG = "jpeg"  # zip of numbered pictures, with poses.txt (TUM) and camera.json
    PNG = "png"  # the same without loss; depth in millimetres, 16 bit


@dataclass(frozen=True)
class PathRenderRequest:
    """Which views, how many, as what.

    `poses` are T_map_camera: those of a path through poses, or the first view of an orbit, which
    without one is the middle of the keyframes. Without `centre` an orbit turns about what its first
    view shows in the middle. Without `intrinsics` the session's colour camera draws, scaled to
    `width` pixels. Videos have even sides: an odd last row or column is left out.
    """

    path: PathKind = PathKind.KEYFRAMES
    poses: tuple[Pose, ...] = ()
    frames: int = 240
    fps: float = 30.0
    format: PathFormat = PathFormat.WEBM
    layer: str = "colour"  # or depth, confidence
    intrinsics: Intrinsics | None = None
    width: int | None = None
    turn_deg: float = 360.0  # of an orbit, seen from above against the clock
    centre: Vector3 | None = None  # of an orbit, metres
    appearance_t_ns: int | None = None


@dataclass(frozen=True)
class PathRenderStatus:
    """How far the views of a path are."""

    job: str
    state: JobState
    frames_done: int
    frames_total: int
    format: PathFormat
    bytes: int = 0  # of the file, once it is done
    error: str = ""

    @property
    def is_running(self) -> bool:
        """Whether there is more to come."""
        return self.state is JobState.RUNNING
