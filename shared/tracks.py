"""What tracking and mapping tell each other: contexts, results, keyframes, candidates."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shared.camera import Calibration
from shared.frames import Frame, Prior, TrackingStatus

NO_LANDMARK = -1
MOVING = -2  # in place of a landmark: the feature is of something that moves
KEYPOINT_BITS = 16


def landmark_id(keyframe_seq: int, keypoint_index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Ids of landmarks first seen by a keyframe: unique in a session without asking anyone."""
    return (np.int64(keyframe_seq) << KEYPOINT_BITS) | keypoint_index


@dataclass(frozen=True)
class PointCloud:
    """Points with unit normals; the frame is named by whoever holds it."""

    points: NDArray[np.float32]  # [N, 3], metres
    normals: NDArray[np.float32]  # [N, 3], towards the camera that saw them


@dataclass(frozen=True)
class Observations:
    """What a keyframe saw of landmarks, or the features of a frame.

    Keypoints are pixels of the rectified colour image; depth is 0 where none is reliable.
    """

    landmark_ids: NDArray[np.int64]  # [M], NO_LANDMARK or MOVING where a feature has none
    keypoints_px: NDArray[np.float32]  # [M, 2]
    octaves: NDArray[np.uint8]  # [M], pyramid level; the pixel sigma is 1.2 ** octave
    depths_m: NDArray[np.float32]  # [M]
    descriptors: NDArray[np.uint8]  # [M, 32], ORB


@dataclass(frozen=True)
class Landmarks:
    """ORB points of the map."""

    ids: NDArray[np.int64]  # [L]
    positions_world: NDArray[np.float64]  # [L, 3]
    normals_world: NDArray[np.float32]  # [L, 3], surface normal, zero where unknown
    descriptors: NDArray[np.uint8]  # [L, 32]
    octaves: NDArray[np.uint8]  # [L], where the descriptor was taken
    distances_m: NDArray[np.float32]  # [L], from the camera that took the descriptor


@dataclass(frozen=True)
class WindowKeyframe:
    """A keyframe of the bundle-adjustment window."""

    seq: int
    T_world_camera: NDArray[np.float64]  # [4, 4]
    is_fixed: bool  # observed, never moved
    observations: Observations  # those of the context's landmarks, and of what moves
    edge_blur_px: float = 0.0


@dataclass(frozen=True)
class TrackingContext:
    """The map around a reference keyframe, as its owner gives it to a tracking worker.

    The same (session, epoch, revision, reference_seq) always means the same content.
    """

    revision: int
    reference_seq: int
    T_world_reference: NDArray[np.float64]  # [4, 4]
    cloud_world: PointCloud
    landmarks: Landmarks
    window: tuple[WindowKeyframe, ...]
    num_keyframes: int
    # Keyframes that may show the reference's place and are not near in the graph, likeliest first.
    loop_seqs: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # [C]


@dataclass(frozen=True)
class Correction:
    """New poses of keyframes, new positions of landmarks; both replace what the map holds."""

    keyframe_seqs: NDArray[np.int64]  # [K]
    T_world_keyframes: NDArray[np.float64]  # [K, 4, 4]
    landmark_ids: NDArray[np.int64]  # [L]
    positions_world: NDArray[np.float64]  # [L, 3]
    # [D, 2], (keyframe seq, landmark id) of observations that turned out to be of something else
    outliers: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))


@dataclass(frozen=True)
class KeyframeLink:
    """How a keyframe hangs on the map that it was tracked in."""

    reference_seq: int  # the keyframe whose neighbourhood that was
    map_revision: int
    information: NDArray[np.float64]  # [6, 6], of a twist on the right of its pose


@dataclass(frozen=True)
class LoopConstraint:
    """A place seen again: a keyframe's pose in the map around an earlier one."""

    earlier_seq: int
    T_earlier_keyframe: NDArray[np.float64]  # [4, 4]
    information: NDArray[np.float64]  # [6, 6], of a twist on the right of it
    landmark_ids: NDArray[np.int64]  # [P, 2], one point's landmark there and in the keyframe


@dataclass(frozen=True)
class KeyframeData:
    """What a frame brings to the map when it becomes a keyframe."""

    observations: Observations  # every feature, matched or new
    landmark_normals_camera: NDArray[np.float32]  # [M, 3], zero where unknown
    cloud_camera: PointCloud
    thumbnail: NDArray[np.uint8]  # [15, 20], grey, for place recognition
    correction: Correction  # by the local bundle adjustment; new landmarks are in it too
    edge_blur_px: float = 0.0  # standard deviation of the blur of its edges, 0 where unknown
    link: KeyframeLink | None = None  # None: the first keyframe, or one of an older log
    loop: LoopConstraint | None = None
    # [H / 8, W / 8], `pixel_cells` of what moves otherwise than the map; None: nothing does
    moving_cells: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class TrackResult:
    """A tracking worker's answer. A frame without a pose (LOST) has the prior's pose repeated."""

    seq: int
    t_ns: int
    status: TrackingStatus
    T_world_camera: NDArray[np.float64]  # [4, 4]
    covariance: NDArray[np.float64]  # [6, 6], of a twist (rho, phi) on the right of it
    reference_seq: int
    T_reference_camera: NDArray[np.float64]  # [4, 4]
    inliers: int
    inlier_share: float
    map_revision: int
    timings_ms: dict[str, float] = field(default_factory=dict)
    keyframe: KeyframeData | None = None
    # [4, 4], motion since the prior's frame; both poses in the map of this revision
    T_last_camera: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class FrameRecord:
    """What the map's owner keeps of every answered frame: its pose relative to a keyframe."""

    seq: int
    t_ns: int
    status: TrackingStatus
    reference_seq: int
    T_reference_camera: NDArray[np.float64]  # [4, 4]
    T_world_camera: NDArray[np.float64]  # [4, 4], as the client was told
    covariance: NDArray[np.float64]  # [6, 6]


@dataclass(frozen=True)
class Advance:
    """One entry of a session's log: an answered frame and, for a keyframe, all that it brings.

    `claim` is the number under which the sender advances the session; `prior` is what the next
    frame starts from, so that whoever takes the session up goes on as if nothing had happened.
    """

    record: FrameRecord
    claim: int = field(default=0, kw_only=True)
    prior: Prior | None = field(default=None, kw_only=True)
    frame: Frame | None = None  # the encoded images, for keyframes
    keyframe: KeyframeData | None = None


@dataclass(frozen=True)
class AdvanceReply:
    """The log holds the entry (on disk where it is a keyframe) and the map has this revision."""

    acknowledged_seq: int
    map_revision: int


@dataclass(frozen=True)
class ContextRequest:
    """A worker asks the map's owner for the neighbourhood of a keyframe."""

    revision: int
    reference_seq: int
    is_near_only: bool = False  # only what is near in the graph, which drift cannot have displaced


@dataclass(frozen=True)
class CandidatesRequest:
    """A worker that lost the camera asks which keyframes look like this frame.

    Where the camera is thought to be somewhere, the keyframe with the nearest view comes first.
    """

    thumbnail: NDArray[np.uint8]  # [15, 20]
    descriptors: NDArray[np.uint8]  # [M, 32]
    limit: int = 5
    T_world_prior: NDArray[np.float64] | None = None  # [4, 4]


@dataclass(frozen=True)
class Candidate:
    """A keyframe that looks alike, with the landmarks it saw."""

    seq: int
    T_world_camera: NDArray[np.float64]  # [4, 4]
    landmarks: Landmarks


@dataclass(frozen=True)
class Candidates:
    """Answer to a CandidatesRequest, most alike first."""

    revision: int
    keyframes: tuple[Candidate, ...]


@dataclass(frozen=True)
class KeyframePoses:
    """Present poses of all keyframes, published with every revision."""

    revision: int
    seqs: NDArray[np.int64]  # [K]
    T_world_keyframes: NDArray[np.float64]  # [K, 4, 4]
    loops: int = 0  # places seen again and joined so far


@dataclass(frozen=True)
class OpenRequest:
    """Create a session, or take it up again from disk (`calibration` None)."""

    session: str
    mode: str  # "offline" or "live"
    seed: int = 0
    calibration: Calibration | None = None
    T_world_first: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class OpenReply:
    """The session as its new owner holds it; `last` is None in a new session."""

    session: str
    mapper: str
    epoch: int
    mode: str
    map_revision: int
    created_ns: int
    calibration: Calibration
    T_world_first: NDArray[np.float64]
    last: FrameRecord | None
    keyframe_poses: KeyframePoses
    prior: Prior | None = None  # after the last frame; None too in a log of older versions


@dataclass(frozen=True)
class ClaimRequest:
    """A gateway wants to advance a session; `held` is the number of its claim, if it has one."""

    gateway: str
    held: int = 0


@dataclass(frozen=True)
class ClaimReply:
    """The newest claim; older ones advance nothing any more.

    `opened` is the session as it is now; None where the asker's claim is the newest.
    """

    number: int
    opened: OpenReply | None


@dataclass(frozen=True)
class Advanced:
    """Published by the owner with every frame that it logs, and without one for a new claim."""

    claim: int
    map_revision: int
    record: FrameRecord | None = None
