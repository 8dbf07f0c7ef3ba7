"""The neighbourhood of a keyframe, as tracking wants it: merged cloud, landmarks, window.

Everything here is a function of the keyframes and of the reference, so that the same revision and
reference always give the same context, in whichever process and after whichever restart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.mapping.anchors.membership import is_among
from services.mapping.keyframes.stored import LandmarkTable, StoredKeyframe
from services.mapping.keyframes.voxel_merge import merge_clouds
from shared.errors import ConfigError
from shared.free_space import seen_through
from shared.se3 import inverse, rotate, transform
from shared.tracks import (
    KEYPOINT_BITS,
    MOVING,
    Landmarks,
    Observations,
    PointCloud,
    TrackingContext,
    WindowKeyframe,
)

_AT_LEAST_ONE = (
    "max_keyframes",
    "max_points",
    "max_landmarks",
    "max_free_keyframes",
    "max_waiting_keyframes",
)


@dataclass(frozen=True)
class ContextConfig:
    """How large a neighbourhood is."""

    voxel_size_m: float = 0.02
    max_keyframes: int = 16  # whose clouds and landmarks enter
    min_overlap: float = 0.1  # share of the reference's points that a keyframe may see
    max_points: int = 60000
    max_landmarks: int = 4000
    max_free_keyframes: int = 8  # of the bundle-adjustment window
    max_fixed_keyframes: int = 7
    max_waiting_keyframes: int = 5  # the newest of the window, with features that have no place
    min_shared_landmarks: int = 15  # with the reference, for a place in the window
    overlap_samples: int = 256

    def __post_init__(self) -> None:
        if not 0.001 <= self.voxel_size_m <= 1.0:
            raise ConfigError(f"voxel_size_m must be 0.001 to 1, got {self.voxel_size_m}")
        for name in _AT_LEAST_ONE:
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1, got {getattr(self, name)}")


def empty_context(revision: int) -> TrackingContext:
    """The context of a map without keyframes."""
    return TrackingContext(
        revision=revision,
        reference_seq=-1,
        T_world_reference=np.eye(4),
        cloud_world=PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)),
        landmarks=landmarks_seen(LandmarkTable(), [], np.zeros(0, np.int64)),
        window=(),
        num_keyframes=0,
    )


@dataclass(frozen=True)
class Neighbourhood:
    """A keyframe among those that a context may be built of."""

    reference: StoredKeyframe
    near: list[StoredKeyframe]  # itself and all that may take part, by seq
    first_seq: int  # the first keyframe of the map
    num_keyframes: int  # of the map
    loop_seqs: list[int]


def build_context(
    around: Neighbourhood, table: LandmarkTable, revision: int, config: ContextConfig
) -> TrackingContext:
    """The context of one keyframe."""
    near = overlapping(around.reference, around.near, config)
    ids = _context_landmark_ids(near, table, config)
    return TrackingContext(
        revision=revision,
        reference_seq=around.reference.seq,
        T_world_reference=around.reference.T_world_camera,
        cloud_world=_merged_cloud(near, config),
        landmarks=landmarks_seen(table, near, ids),
        window=_window(near, (table, ids), around.first_seq, config),
        num_keyframes=around.num_keyframes,
        loop_seqs=np.array(around.loop_seqs, np.int64),
    )


def overlapping(
    reference: StoredKeyframe, keyframes: list[StoredKeyframe], config: ContextConfig
) -> list[StoredKeyframe]:
    """The keyframes that see most of the reference's surface, itself first.

    Where one of two has no surface, most of the reference's landmarks.
    """
    cloud = reference.cloud_camera
    step = max(1, len(cloud.points) // config.overlap_samples)
    points = transform(reference.T_world_camera, cloud.points[::step].astype(np.float64))
    normals = rotate(reference.T_world_camera, cloud.normals[::step].astype(np.float64))
    shares = visible_shares(points, normals, keyframes)
    for i, keyframe in enumerate(keyframes):
        if min(len(cloud.points), len(keyframe.cloud_camera.points)) == 0:
            shares[i] = _shared_landmarks(reference, keyframe)
    order = np.argsort(-shares, kind="stable")
    chosen = [keyframes[i] for i in order if shares[i] >= config.min_overlap]
    others = [keyframe for keyframe in chosen if keyframe.seq != reference.seq]
    return [reference, *others[: config.max_keyframes - 1]]


def _shared_landmarks(reference: StoredKeyframe, other: StoredKeyframe) -> float:
    """Share of the reference's features with a landmark that another keyframe saw."""
    ids = reference.observations.landmark_ids
    ids = ids[ids >= 0]
    return float(is_among(ids, other.observations.landmark_ids).mean()) if len(ids) else 0.0


def visible_shares(
    points_world: NDArray, normals_world: NDArray, keyframes: list[StoredKeyframe]
) -> NDArray[np.float64]:
    """Share of the points that lie in each keyframe's cone and face it, [K]."""
    poses = np.stack([keyframe.T_world_camera for keyframe in keyframes])
    low = np.stack([keyframe.cone.low for keyframe in keyframes])
    high = np.stack([keyframe.cone.high for keyframe in keyframes])
    far = np.array([keyframe.cone.far_m for keyframe in keyframes])
    counts = _count_visible(points_world, normals_world, inverse(poses), low, high, 1.1 * far)
    return counts / max(1, len(points_world))


@numba.njit(cache=True, nogil=True)
def _count_visible(  # noqa: PLR0913 - compiled
    points, normals, views, low, high, far
):  # pragma: no cover - compiled
    """How many points lie in each view's cone and face it, [K]."""
    counts = np.zeros(len(views))
    for k in range(len(views)):
        T = views[k]
        for n in range(len(points)):
            p, m = points[n], normals[n]
            z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
            if z <= 0.05 or z >= far[k]:
                continue
            x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
            y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
            u, v = x / z, y / z
            if u < low[k, 0] or u > high[k, 0] or v < low[k, 1] or v > high[k, 1]:
                continue
            facing = x * (T[0, 0] * m[0] + T[0, 1] * m[1] + T[0, 2] * m[2])
            facing += y * (T[1, 0] * m[0] + T[1, 1] * m[1] + T[1, 2] * m[2])
            facing += z * (T[2, 0] * m[0] + T[2, 1] * m[1] + T[2, 2] * m[2])
            if facing < 0.0:
                counts[k] += 1.0
    return counts


def _merged_cloud(keyframes: list[StoredKeyframe], config: ContextConfig) -> PointCloud:
    # Voxels are in order of first sight, best overlap first: the tail is what matters least.
    merged = merge_clouds(
        [keyframe.cloud_camera for keyframe in keyframes],
        [keyframe.T_world_camera for keyframe in keyframes],
        config.voxel_size_m,
        config.max_points,
    )
    # Thin things that the reference missed would go too, so only where something moves.
    has_moving = any((k.observations.landmark_ids == MOVING).any() for k in keyframes)
    return _still_there(merged, keyframes[0]) if has_moving else merged


def _still_there(cloud_world: PointCloud, reference: StoredKeyframe) -> PointCloud:
    """The cloud without what the reference looked through: what stood there has gone."""
    free = seen_through(reference.cloud_camera.points, np.eye(4))
    verdicts = free.verdicts(cloud_world.points, inverse(reference.T_world_camera))
    stays = verdicts <= 0
    return PointCloud(cloud_world.points[stays], cloud_world.normals[stays])


def _context_landmark_ids(
    near: list[StoredKeyframe], table: LandmarkTable, config: ContextConfig
) -> NDArray[np.int64]:
    """Landmarks that the keyframes saw more than once, or that are new; ascending ids."""
    seen = np.concatenate([keyframe.observations.landmark_ids for keyframe in near])
    ids, counts = np.unique(seen[seen >= 0], return_counts=True)
    is_young = (ids >> KEYPOINT_BITS) >= near[0].seq
    keep = (table.rows(ids) >= 0) & ((counts > 1) | is_young)
    ids, counts = ids[keep], counts[keep]
    order = np.argsort(-counts, kind="stable")[: config.max_landmarks]
    return np.sort(ids[order])


def landmarks_seen(
    table: LandmarkTable, keyframes: list[StoredKeyframe], ids: NDArray[np.int64]
) -> Landmarks:
    """The landmarks of ascending ids, described as the first of the keyframes saw them."""
    rows = table.rows(ids)
    positions = table.positions_world[rows]
    descriptors = np.zeros((len(ids), 32), np.uint8)
    octaves = np.zeros(len(ids), np.uint8)
    distances = np.zeros(len(ids), np.float32)
    for keyframe in reversed(keyframes):
        observations = keyframe.observations
        at, mine = _rows_of(ids, observations.landmark_ids)
        descriptors[at] = observations.descriptors[mine]
        octaves[at] = observations.octaves[mine]
        distances[at] = np.linalg.norm(positions[at] - keyframe.T_world_camera[:3, 3], axis=1)
    return Landmarks(ids, positions, table.normals_world[rows], descriptors, octaves, distances)


def _rows_of(
    ids: NDArray[np.int64], observed: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (row in ids, row in observed) of equal ids; ids ascend."""
    if len(ids) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    at = np.minimum(np.searchsorted(ids, observed), len(ids) - 1)
    mine = np.flatnonzero(ids[at] == observed)
    return at[mine], mine


def _window(
    near: list[StoredKeyframe],
    landmarks: tuple[LandmarkTable, NDArray[np.int64]],
    first_seq: int,
    config: ContextConfig,
) -> tuple[WindowKeyframe, ...]:
    """Bundle-adjustment window: the reference, then the keyframes that share most landmarks."""
    reference_ids = near[0].observations.landmark_ids
    reference_ids = reference_ids[reference_ids >= 0]
    shared = [is_among(k.observations.landmark_ids, reference_ids).sum() for k in near]
    ranked = [i for i in np.argsort(-np.array(shared), kind="stable") if i > 0]
    covisible = [near[i] for i in ranked if shared[i] >= config.min_shared_landmarks]
    free = [near[0], *covisible[: config.max_free_keyframes - 1]]
    fixed = covisible[config.max_free_keyframes - 1 :][: config.max_fixed_keyframes]
    members = sorted(free + fixed, key=lambda keyframe: keyframe.seq)
    # Something must hold the window in place: the first keyframe, or else the oldest.
    fixed_seqs = {k.seq for k in fixed} | {first_seq}
    fixed_seqs |= set() if fixed else {members[0].seq}
    newest = {keyframe.seq for keyframe in members[-config.max_waiting_keyframes :]}
    return tuple(
        WindowKeyframe(
            seq=keyframe.seq,
            T_world_camera=keyframe.T_world_camera,
            is_fixed=keyframe.seq in fixed_seqs,
            observations=_observations_of(keyframe, landmarks, keyframe.seq in newest),
            edge_blur_px=keyframe.edge_blur_px,
        )
        for keyframe in members
    )


def _observations_of(
    keyframe: StoredKeyframe,
    landmarks: tuple[LandmarkTable, NDArray[np.int64]],
    with_waiting: bool,
) -> Observations:
    """Those of the context's landmarks, of what moves and, if wanted, of what has no place yet."""
    table, ids = landmarks
    seen = keyframe.observations
    keep = is_among(seen.landmark_ids, ids) | (seen.landmark_ids == MOVING)
    if with_waiting:
        own = (seen.landmark_ids >> KEYPOINT_BITS) == keyframe.seq
        keep |= own & (table.rows(seen.landmark_ids) < 0)
    rows = np.flatnonzero(keep)
    return Observations(
        landmark_ids=seen.landmark_ids[rows],
        keypoints_px=seen.keypoints_px[rows],
        octaves=seen.octaves[rows],
        depths_m=seen.depths_m[rows],
        descriptors=seen.descriptors[rows],
    )
