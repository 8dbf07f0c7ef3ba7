"""The bundle-adjustment window of a new keyframe: from the context to a problem and back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.bundle_adjustment import BundleProblem, pixel_chi2, solve_bundle
from services.tracking.config import TrackingConfig
from services.tracking.orb import backproject
from services.tracking.registration import Registration, optimum
from services.tracking.triangulation import triangulate
from shared.camera import Intrinsics
from shared.se3 import inverse, transform
from shared.tracks import (
    KEYPOINT_BITS,
    Correction,
    Landmarks,
    Observations,
    PointCloud,
    TrackingContext,
    WindowKeyframe,
)


@dataclass(frozen=True)
class NewKeyframe:
    """A keyframe before bundle adjustment."""

    seq: int
    T_world_camera: NDArray[np.float64]  # [4, 4]
    observations: Observations
    registration: Registration


@dataclass(frozen=True)
class AdjustedKeyframe:
    """A keyframe after bundle adjustment."""

    observations: Observations  # with the earlier keyframes' landmarks that it placed
    correction: Correction


@dataclass(frozen=True)
class _Observed:
    """Observations of several cameras in one list, by ascending landmark."""

    camera_index: NDArray[np.int64]  # [O]
    point_index: NDArray[np.int64]  # [O]
    measured: NDArray[np.float64]  # [O, 3]
    sigmas: NDArray[np.float64]  # [O, 2]


def adjust_window(
    keyframe: NewKeyframe,
    context: TrackingContext,
    intrinsics: Intrinsics,
    config: TrackingConfig,
) -> AdjustedKeyframe:
    """Adjust the new keyframe with its window and place the landmarks that it found.

    Features without depth become landmarks where an earlier keyframe sees them too. The correction
    has new poses of the window's free keyframes and of this one (last), new positions of the
    adjusted landmarks and first positions of the new ones.
    """
    window = (*context.window, _as_window(keyframe))
    observed = _observed(window, context.landmarks, config)
    seen = np.unique(observed.point_index)
    held = _held_by_geometry(keyframe, window, context, intrinsics, config)
    problem = BundleProblem(
        T_world_cameras=np.stack([member.T_world_camera for member in window]),
        is_fixed=np.array([member.is_fixed for member in window]),
        T_world_priors=held.T_world_cameras,
        pose_information=held.information,
        points_world=context.landmarks.positions_world[seen],
        camera_index=observed.camera_index,
        point_index=np.searchsorted(seen, observed.point_index),
        measured=observed.measured,
        sigmas=observed.sigmas,
    )
    solution = solve_bundle(problem, intrinsics, config.bundle_adjustment)
    poses = solution.T_world_cameras
    *adjusted, new = (replace(w, T_world_camera=T) for w, T in zip(window, poses, strict=True))
    placed = triangulate(new, tuple(adjusted), intrinsics, config.triangulation)
    ids = context.landmarks.ids[seen]
    landmarks = [
        (ids, solution.points_world),
        _own_landmarks(new.seq, new.T_world_camera, new.observations, intrinsics),
        (placed.landmark_ids, placed.positions_world),
    ]
    is_outlier = pixel_chi2(problem, solution, intrinsics) > config.bundle_adjustment.outlier_chi2
    outliers = _named(problem, is_outlier, window, ids)
    correction = _correction((*adjusted, new), landmarks, outliers)
    return AdjustedKeyframe(placed.named(new.observations), correction)


def _named(
    problem: BundleProblem,
    which: NDArray[np.bool_],
    window: tuple[WindowKeyframe, ...],
    ids: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Some observations as (keyframe seq, landmark id), [D, 2]."""
    seqs = np.array([keyframe.seq for keyframe in window], np.int64)
    return np.column_stack([seqs[problem.camera_index[which]], ids[problem.point_index[which]]])


_Placed = tuple[NDArray[np.int64], NDArray[np.float64]]  # ids [L], positions in the world [L, 3]


def _correction(
    window: tuple[WindowKeyframe, ...], placed: list[_Placed], outliers: NDArray[np.int64]
) -> Correction:
    free = [keyframe for keyframe in window if not keyframe.is_fixed]
    return Correction(
        keyframe_seqs=np.array([keyframe.seq for keyframe in free], np.int64),
        T_world_keyframes=np.stack([keyframe.T_world_camera for keyframe in free]),
        landmark_ids=np.concatenate([ids for ids, _ in placed]),
        positions_world=np.concatenate([positions for _, positions in placed]),
        outliers=outliers,
    )


def _as_window(keyframe: NewKeyframe) -> WindowKeyframe:
    return WindowKeyframe(
        keyframe.seq, keyframe.T_world_camera, is_fixed=False, observations=keyframe.observations
    )


def first_correction(
    seq: int,
    T_world_camera: NDArray[np.float64],
    observations: Observations,
    intrinsics: Intrinsics,
) -> Correction:
    """The correction of a session's first keyframe: its own pose and landmarks."""
    ids, positions = _own_landmarks(seq, T_world_camera, observations, intrinsics)
    return Correction(np.array([seq], np.int64), T_world_camera[None], ids, positions)


def _own_landmarks(
    seq: int,
    T_world_camera: NDArray[np.float64],
    observations: Observations,
    intrinsics: Intrinsics,
) -> _Placed:
    """Ids and positions of the landmarks that a keyframe founds with its depth."""
    ids = observations.landmark_ids
    own = np.flatnonzero(((ids >> KEYPOINT_BITS) == seq) & (observations.depths_m > 0.0))
    points = backproject(observations.keypoints_px[own], observations.depths_m[own], intrinsics)
    return ids[own], transform(T_world_camera, points)


def _observed(
    window: tuple[WindowKeyframe, ...], landmarks: Landmarks, config: TrackingConfig
) -> _Observed:
    """All observations of landmarks that at least two cameras of the window see."""
    parts = [_camera_rows(k, w.observations, landmarks.ids, config) for k, w in enumerate(window)]
    cameras, points, measured, sigmas = (np.concatenate(part) for part in zip(*parts, strict=True))
    counts = np.bincount(points, minlength=len(landmarks.ids))
    keep = np.flatnonzero(counts[points] >= 2)
    order = keep[np.argsort(points[keep], kind="stable")]
    return _Observed(cameras[order], points[order], measured[order], sigmas[order])


def _camera_rows(
    camera: int, observations: Observations, ids: NDArray[np.int64], config: TrackingConfig
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    ba = config.bundle_adjustment
    at = np.minimum(np.searchsorted(ids, observations.landmark_ids), max(len(ids) - 1, 0))
    known = ids[at] == observations.landmark_ids if len(ids) else np.zeros(len(at), np.bool_)
    rows = np.flatnonzero(known)
    depths = observations.depths_m[rows].astype(np.float64)
    measured = np.column_stack([observations.keypoints_px[rows], depths]).astype(np.float64)
    pixel_sigmas = ba.pixel_sigma * 1.2 ** observations.octaves[rows].astype(np.float64)
    depth_sigmas = ba.depth_sigma_floor_m + ba.depth_sigma_per_m2 * depths**2
    cameras = np.full(len(rows), camera, np.int64)
    return cameras, at[rows], measured, np.column_stack([pixel_sigmas, depth_sigmas])


@dataclass(frozen=True)
class _Held:
    """Where geometry holds the cameras of a window, and how firmly."""

    T_world_cameras: NDArray[np.float64]  # [K, 4, 4]
    information: NDArray[np.float64]  # [K, 6, 6]


def _held_by_geometry(
    keyframe: NewKeyframe,
    window: tuple[WindowKeyframe, ...],
    context: TrackingContext,
    intrinsics: Intrinsics,
    config: TrackingConfig,
) -> _Held:
    """The new keyframe where it registers best, the others where they are; fixed ones need none."""
    poses = np.stack([member.T_world_camera for member in window])
    free = np.flatnonzero([not member.is_fixed for member in window])
    information = np.zeros((len(window), 6, 6))
    information[free] = pose_information(
        context.cloud_world, poses[free], keyframe.registration, intrinsics, config
    )
    poses[-1] = optimum(keyframe.registration, config.registration)
    information[-1] = keyframe.registration.information
    return _Held(poses, config.bundle_adjustment.pose_prior_share * information)


def pose_information(
    cloud_world: PointCloud,
    T_world_cameras: NDArray[np.float64],
    registration: Registration,
    intrinsics: Intrinsics,
    config: TrackingConfig,
) -> NDArray[np.float64]:
    """What registering cameras to a cloud would tell of their poses, [K, 6, 6].

    The noise is that of the registration at hand: the same sensor in the same scene.
    """
    settings = config.registration
    sigma = max(registration.residual_scale, settings.model_sigma)
    i = intrinsics
    hessians = _visible_hessians(
        cloud_world.points[::_CLOUD_STEP],
        cloud_world.normals[::_CLOUD_STEP],
        inverse(T_world_cameras),
        np.array([i.fx, i.fy, i.cx, i.cy, i.width, i.height]),
        np.array([settings.depth_sigma_floor_m, settings.depth_sigma_per_m2]),
    )
    return _CLOUD_STEP * settings.effective_share / sigma**2 * hessians


_CLOUD_STEP = 4


@numba.njit(cache=True, nogil=True)
def _visible_hessians(  # noqa: C901 - compiled
    points, normals, views, camera, noise
):  # pragma: no cover - compiled
    out = np.zeros((len(views), 6, 6))
    J = np.zeros(6)
    p = np.zeros(3)
    m = np.zeros(3)
    for k in range(len(views)):
        T = views[k]
        for n in range(len(points)):
            # Most points are out of sight: normals are turned for the others only.
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            p[2] = T[2, 3] + T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
            if p[2] < 0.1:
                continue
            p[0] = T[0, 3] + T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
            p[1] = T[1, 3] + T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
            u = camera[0] * p[0] / p[2] + camera[2]
            v = camera[1] * p[1] / p[2] + camera[3]
            if u < 0.0 or v < 0.0 or u >= camera[4] or v >= camera[5]:
                continue
            for i in range(3):
                m[i] = 0.0
                for j in range(3):
                    m[i] += T[i, j] * normals[n, j]
            if p[0] * m[0] + p[1] * m[1] + p[2] * m[2] >= 0.0:
                continue
            weight = 1.0 / (noise[0] + noise[1] * p[2] * p[2]) ** 2
            J[0], J[1], J[2] = m[0], m[1], m[2]
            J[3] = p[1] * m[2] - p[2] * m[1]
            J[4] = p[2] * m[0] - p[0] * m[2]
            J[5] = p[0] * m[1] - p[1] * m[0]
            for i in range(6):
                scaled = weight * J[i]
                for j in range(i, 6):
                    out[k, i, j] += scaled * J[j]
        for i in range(6):
            for j in range(i):
                out[k, i, j] = out[k, j, i]
    return out
