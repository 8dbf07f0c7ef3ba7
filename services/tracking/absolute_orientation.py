"""A frame's pose from features with depth: absolute orientation inside RANSAC.

Three pairs of points give a pose in closed form, all that agree with the best of them a better one
(Horn, JOSA A 1987; Umeyama, TPAMI 1991, for the solution by singular values). A sample costs a
hundredth of what it costs without depth; pairs without depth are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import FeatureStartConfig, TrackingConfig
from services.tracking.matching import match_by_descriptor
from services.tracking.orb import Features
from services.tracking.twists import inverse_rigid
from shared.camera import Intrinsics
from shared.tracks import Landmarks


@dataclass(frozen=True)
class PointPairs:
    """Points that a frame measures, and where the map has them."""

    points_camera: NDArray[np.float64]  # [P, 3]
    points_world: NDArray[np.float64]  # [P, 3]
    keypoints_px: NDArray[np.float64]  # [P, 2]

    def where(self, keep: NDArray[np.bool_]) -> PointPairs:
        """Some of the pairs."""
        return PointPairs(
            self.points_camera[keep], self.points_world[keep], self.keypoints_px[keep]
        )


def locate_by_points(
    features: Features, landmarks: Landmarks, intrinsics: Intrinsics, config: TrackingConfig
) -> NDArray[np.float64] | None:
    """T_world_camera by descriptors of a frame's best features, or None where too few agree."""
    best = features.first(config.feature_start.num_features)
    matches = match_by_descriptor(best, landmarks, config.orb)
    pairs = PointPairs(
        best.points_camera(intrinsics)[matches.features],
        landmarks.positions_world[matches.landmarks],
        best.keypoints_px[matches.features].astype(np.float64),
    )
    has_depth = pairs.points_camera[:, 2] > 0.0
    return solve_points(pairs.where(has_depth), intrinsics, config.feature_start)


def solve_points(
    pairs: PointPairs, intrinsics: Intrinsics, config: FeatureStartConfig
) -> NDArray[np.float64] | None:
    """T_world_camera that most pairs agree with, [4, 4]; None where these are too few."""
    if len(pairs.keypoints_px) < config.min_inliers:
        return None
    camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    arrays = (pairs.points_camera, pairs.points_world, pairs.keypoints_px)
    T, votes = _best_sample(arrays, camera, config.sample_px, config.num_samples)
    if votes < config.min_inliers:
        return None
    for limit_px in (config.sample_px, config.inlier_px):
        is_inlier = _errors_px(pairs, T, camera) < limit_px
        if is_inlier.sum() < config.min_inliers:
            return None
        T = _orientation(pairs.where(is_inlier))
    return T


def _errors_px(
    pairs: PointPairs, T_world_camera: NDArray[np.float64], camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Reprojection errors, [P]; infinite behind the camera."""
    view = inverse_rigid(T_world_camera)
    points = pairs.points_world @ view[:3, :3].T + view[:3, 3]
    z = np.maximum(points[:, 2], 1e-3)
    projected = camera[:2] * points[:, :2] / z[:, None] + camera[2:]
    errors = np.linalg.norm(projected - pairs.keypoints_px, axis=1)
    return np.where(points[:, 2] > 0.05, errors, np.inf)


def _orientation(pairs: PointPairs) -> NDArray[np.float64]:
    """Least squares T_world_camera; depth errs with its square, so far pairs count less."""
    weights = 1.0 / np.square(0.5 + np.square(pairs.points_camera[:, 2]))
    weights /= weights.sum()
    mean_camera, mean_world = weights @ pairs.points_camera, weights @ pairs.points_world
    spread = (pairs.points_world - mean_world).T * weights @ (pairs.points_camera - mean_camera)
    u, _, vt = np.linalg.svd(spread)
    T = np.eye(4)
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    T[:3, 3] = mean_world - T[:3, :3] @ mean_camera
    return T


@numba.njit(cache=True, nogil=True)
def _best_sample(pairs, camera, limit_px, num_samples):  # pragma: no cover - compiled
    """The pose of three pairs that most pairs agree with, T_world_camera, and how many do."""
    points_camera, points_world, keypoints = pairs
    count = len(keypoints)
    best_T, best_votes = np.eye(4), 0
    state = np.uint64(88172645463325252)  # xorshift64 (Marsaglia, 2003): the same samples always
    rows = np.zeros(3, np.int64)
    for _ in range(num_samples):
        for k in range(3):
            state ^= state << np.uint64(13)
            state ^= state >> np.uint64(7)
            state ^= state << np.uint64(17)
            rows[k] = np.int64(state % np.uint64(count))
        if not _is_congruent(points_camera, points_world, rows):
            continue
        R_camera, R_world = _triad(points_camera, rows), _triad(points_world, rows)
        R = R_world @ R_camera.T
        t = points_world[rows[0]] - R @ points_camera[rows[0]]
        votes = _votes(points_world, keypoints, R, t, camera, limit_px)
        if votes > best_votes:
            best_votes = votes
            best_T[:3, :3], best_T[:3, 3] = R, t
    return best_T, best_votes


@numba.njit(cache=True, nogil=True)
def _is_congruent(points_camera, points_world, rows):  # pragma: no cover - compiled
    """Whether three pairs are a triangle of some size, and about the same one in both frames."""
    shortest, longest, half = np.inf, 0.0, 0.0
    for k in range(3):
        i, j = rows[k], rows[(k + 1) % 3]
        a = np.sqrt(((points_camera[i] - points_camera[j]) ** 2).sum())
        b = np.sqrt(((points_world[i] - points_world[j]) ** 2).sum())
        if abs(a - b) > 0.05 + 0.05 * a:
            return False
        shortest, longest, half = min(shortest, a), max(longest, a), half + 0.5 * a
    # The two shorter sides of a triangle of points on a line are as long as the longest.
    return shortest > 0.2 and half - longest > 0.02 * longest


@numba.njit(cache=True, nogil=True)
def _triad(points, rows):  # pragma: no cover - compiled
    """Axes of a triangle: along its first side, in its plane, along its normal."""
    x = points[rows[1]] - points[rows[0]]
    x = x / np.sqrt((x**2).sum())
    y = points[rows[2]] - points[rows[0]]
    y = y - (x * y).sum() * x
    y = y / max(np.sqrt((y**2).sum()), 1e-9)
    out = np.empty((3, 3))
    out[:, 0], out[:, 1] = x, y
    out[:, 2] = np.cross(x, y)
    return out


@numba.njit(cache=True, nogil=True)
def _votes(points_world, keypoints, R, t, camera, limit_px):  # noqa: PLR0913 - compiled
    """How many points fall on their pixels from a camera at (R, t)."""
    votes = 0
    for n in range(len(keypoints)):
        p = points_world[n]
        dx, dy, dz = p[0] - t[0], p[1] - t[1], p[2] - t[2]
        z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        if z < 0.05:
            continue
        u = camera[0] * (R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) / z + camera[2]
        v = camera[1] * (R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) / z + camera[3]
        if (u - keypoints[n, 0]) ** 2 + (v - keypoints[n, 1]) ** 2 < limit_px * limit_px:
            votes += 1
    return votes
