"""Questions to the owner of a map: information, renders, exports, trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.frames import ColourImage
from shared.tracks import FrameRecord


@dataclass(frozen=True)
class RenderRequest:
    """A view of the map. Without a time the map's mean appearance is drawn.

    `unless_state` is the state of a reply that the asker still has: while the map would give it
    again, the new reply has that state and images without pixels.
    """

    T_world_camera: NDArray[np.float64]  # [4, 4]
    intrinsics: Intrinsics
    appearance_t_ns: int | None = None
    unless_state: str = ""


@dataclass(frozen=True)
class RenderReply:
    """A rendered view. Depth is 0 where alpha is 0; a view of nothing is black with alpha 0.

    Confidence says how well the map knows what it shows: 255 where keyframes saw the surface from
    much the same side and distance, 0 where nothing is known.
    """

    revision: int
    rgb: NDArray[np.uint8]  # [H, W, 3]
    depth_m: NDArray[np.float32]  # [H, W], along the optical axis
    alpha: NDArray[np.uint8]  # [H, W], 255 is opaque
    confidence: NDArray[np.uint8]  # [H, W]
    state: str = ""  # epoch.revision.iterations of the map that was drawn


class ExportFormat(StrEnum):
    """What a map can be written as."""

    PLY = "ply"  # 3DGS splats
    SPZ = "spz"  # the same at a tenth of the size, quantised
    GLB = "glb"  # the same as binary glTF, KHR_gaussian_splatting
    MESH = "mesh"  # triangle mesh, PLY
    MESH_GLB = "mesh-glb"  # triangle mesh, binary glTF
    POINTS = "points"  # points of the surface with normals, PLY
    SNAPSHOT = "snapshot"  # tar of the session folder, to resume elsewhere
    PREVIEW = "preview"  # the splats that show most, without harmonics: quick to make, small


SUFFIXES = {
    ExportFormat.PLY: "ply",
    ExportFormat.SPZ: "spz",
    ExportFormat.GLB: "glb",
    ExportFormat.MESH: "mesh.ply",
    ExportFormat.MESH_GLB: "mesh.glb",
    ExportFormat.POINTS: "points.ply",
    ExportFormat.SNAPSHOT: "tar",
    ExportFormat.PREVIEW: "preview.ply",
}


@dataclass(frozen=True)
class ExportRequest:
    """The map as a file, one piece a query, so that the reader sets the pace.

    Without `export` a new file is made and its first piece given; later pieces are asked for by
    the name that came with it.
    """

    format: ExportFormat
    export: str = ""
    offset: int = 0


@dataclass(frozen=True)
class ExportChunk:
    """One piece of an exported file."""

    offset: int
    total: int
    bytes: bytes
    export: str = ""  # by this name the next piece is asked for


@dataclass(frozen=True)
class KeyframeRequest:
    """The recorded image of a keyframe."""

    seq: int


@dataclass(frozen=True)
class KeyframeReply:
    """What a keyframe's camera saw, as a JPEG without lens distortion, and its present pose."""

    seq: int
    t_ns: int
    T_world_camera: NDArray[np.float64]  # [4, 4]
    rgb: ColourImage


@dataclass(frozen=True)
class RefineRequest:
    """Optimise on all keyframes for so many iterations after the online phase."""

    iterations: int


class JobState(StrEnum):
    """What became of a refinement."""

    NONE = "none"  # there was none
    RUNNING = "running"
    DONE = "done"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class JobStatus:
    """The present or the last refinement of a session."""

    state: JobState = JobState.NONE
    iterations_done: int = 0
    iterations_total: int = 0
    psnr_db: float | None = None  # running mean over the last training views
    error: str = ""
    job: int = 0  # counts the refinements of a session

    @property
    def is_running(self) -> bool:
        """Whether there is more to come."""
        return self.state is JobState.RUNNING


@dataclass(frozen=True)
class SaveRequest:
    """Write a snapshot now."""


@dataclass(frozen=True)
class SaveReply:
    """A snapshot is on disk."""

    revision: int
    bytes: int


@dataclass(frozen=True)
class MapInfo:
    """The state of a map, for people and for metrics."""

    session: str
    mapper: str
    epoch: int
    mode: str
    map_revision: int
    frames: int
    keyframes: int
    landmarks: int
    primary_anchors: int
    secondary_anchors: int
    iterations: int
    pending: int  # log entries not yet worked through
    psnr_db: float | None  # running mean over the last training views
    refinement: JobStatus
    stages_ms: dict[str, float]  # medians of one optimization step
    iteration_ms: float | None  # median of one optimization step
    mapping_s: float  # time spent optimizing online
    refinement_s: float
    map_bytes: int  # anchors and networks, without optimizer state
    device: str
    loops: int = 0  # places seen again and joined


@dataclass(frozen=True)
class TrajectoryRequest:
    """All answered frames of a session."""


@dataclass(frozen=True)
class Trajectory:
    """Records as told to the client, and final poses (keyframe corrections applied)."""

    records: tuple[FrameRecord, ...]
    T_world_cameras_final: NDArray[np.float64]  # [F, 4, 4]
    keyframe_seqs: NDArray[np.int64]  # [K]


@dataclass(frozen=True)
class Empty:
    """A request or reply without content."""


@dataclass(frozen=True)
class DeleteRequest:
    """Remove every byte of a session."""

    session: str


@dataclass(frozen=True)
class PinRequest:
    """Keep a session whatever the rule of retention says, or no longer."""

    session: str
    is_pinned: bool


@dataclass(frozen=True)
class SessionSummary:
    """A session on a mapper's disk."""

    session: str
    created_ns: int
    mode: str
    keyframes: int
    is_open: bool
    is_pinned: bool = False  # no rule of retention deletes it


@dataclass(frozen=True)
class SessionList:
    """All sessions of a mapper."""

    sessions: tuple[SessionSummary, ...]
