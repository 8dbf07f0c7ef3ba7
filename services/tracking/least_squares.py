"""Pose-only refinement: features with depth, the point-to-plane term, the registration as prior.

Paper Eq. 2 with a Huber kernel, solved by Levenberg-Marquardt. The registration enters as a
quadratic around its own pose: where there is texture the features rule, where there is geometry
the registration does, and each along the directions that it can see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import RefinementConfig
from services.tracking.matching import Matches
from services.tracking.orb import Features
from services.tracking.registration import Registration
from services.tracking.twists import exp_twist, inverse_rigid, log_twist
from shared.camera import Intrinsics
from shared.se3 import inverse
from shared.tracks import Landmarks


@dataclass(frozen=True)
class PoseObservations:
    """Matched features and what they are matched to."""

    points_world: NDArray[np.float64]  # [P, 3]
    normals_world: NDArray[np.float64]  # [P, 3], zero where unknown
    keypoints_px: NDArray[np.float64]  # [P, 2]
    pixel_sigmas: NDArray[np.float64]  # [P]
    depths_m: NDArray[np.float64]  # [P], 0 where none is reliable
    depth_sigmas_m: NDArray[np.float64]  # [P]


@dataclass(frozen=True)
class Refinement:
    """A refined pose, its information (of a camera twist) and which observations agree."""

    T_world_camera: NDArray[np.float64]  # [4, 4]
    information: NDArray[np.float64]  # [6, 6]
    is_inlier: NDArray[np.bool_]  # [P]


def pose_observations(
    features: Features, landmarks: Landmarks, matches: Matches, config: RefinementConfig
) -> PoseObservations:
    """Gather the matched rows; sigmas follow the pyramid level and the depth."""
    f, l = matches.features, matches.landmarks
    depths = features.depths_m[f].astype(np.float64)
    return PoseObservations(
        points_world=landmarks.positions_world[l],
        normals_world=landmarks.normals_world[l].astype(np.float64),
        keypoints_px=features.keypoints_px[f].astype(np.float64),
        pixel_sigmas=config.pixel_sigma * 1.2 ** features.octaves[f].astype(np.float64),
        depths_m=depths,
        depth_sigmas_m=config.depth_sigma_floor_m + config.depth_sigma_per_m2 * depths**2,
    )


def refine_pose(
    observations: PoseObservations,
    registration: Registration,
    T_start: NDArray[np.float64],
    intrinsics: Intrinsics,
    config: RefinementConfig,
) -> Refinement:
    """Minimise reprojection, depth and point-to-plane errors together with the prior.

    Args:
        observations: matched features.
        registration: the prior, a quadratic around its pose.
        T_start: where to start, T_world_camera.
        intrinsics: the camera of the keypoints.
        config: sigmas, kernel, rounds.
    """
    T = T_start
    camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    is_inlier = np.ones(len(observations.depths_m), np.bool_)
    for _ in range(config.rounds):
        T = _minimise(observations, is_inlier, registration, T, camera, config)
        is_inlier = _chi2(observations, T, camera) < config.outlier_chi2
    H, _, _ = linear_system(observations, is_inlier, T, camera, config)
    return Refinement(T, H + registration.information, is_inlier)


def _minimise(
    observations: PoseObservations,
    is_used: NDArray[np.bool_],
    registration: Registration,
    T: NDArray[np.float64],
    camera: NDArray[np.float64],
    config: RefinementConfig,
) -> NDArray[np.float64]:
    """Levenberg-Marquardt on the observations in use."""
    damping = 1e-6
    H, b, cost = _with_prior(observations, is_used, registration, T, camera, config)
    for _ in range(config.iterations):
        diagonal = np.diag(np.diag(H) * damping + 1e-9)
        twist = -np.linalg.solve(H + diagonal, b)
        T_new = T @ exp_twist(twist)
        H_new, b_new, cost_new = _with_prior(
            observations, is_used, registration, T_new, camera, config
        )
        if cost_new > cost:
            damping *= 10.0
            continue
        T, H, b, cost, damping = T_new, H_new, b_new, cost_new, damping * 0.3
        if np.abs(twist).max() < 1e-6:
            break
    return T


def _with_prior(
    observations: PoseObservations,
    is_used: NDArray[np.bool_],
    registration: Registration,
    T: NDArray[np.float64],
    camera: NDArray[np.float64],
    config: RefinementConfig,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    H, b, cost = linear_system(observations, is_used, T, camera, config)
    step = log_twist(inverse_rigid(registration.T_world_camera) @ T)
    pull = registration.information @ step
    cost += float(step @ pull) + 2.0 * float(registration.gradient @ step)
    return H + registration.information, b + pull + registration.gradient, cost


def linear_system(
    observations: PoseObservations,
    is_used: NDArray[np.bool_],
    T: NDArray[np.float64],
    camera: NDArray[np.float64],
    config: RefinementConfig,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Normal equations (H, b) of a camera twist and the cost, whose gradient is 2 b."""
    o = observations
    return _accumulate(
        o.points_world,
        o.normals_world,
        o.keypoints_px,
        o.pixel_sigmas,
        o.depths_m,
        o.depth_sigmas_m,
        is_used,
        inverse_rigid(T),
        camera,
        config.huber_sigma,
    )


def _chi2(
    observations: PoseObservations, T: NDArray[np.float64], camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Squared normalised error of each observation; infinite behind the camera."""
    T_camera_world = inverse(T)
    points = observations.points_world @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    z = np.maximum(points[:, 2], 1e-3)
    projected = camera[:2] * points[:, :2] / z[:, None] + camera[2:]
    pixels = (projected - observations.keypoints_px) / observations.pixel_sigmas[:, None]
    depth = (points[:, 2] - observations.depths_m) / observations.depth_sigmas_m
    depth = np.where(observations.depths_m > 0.0, depth, 0.0)
    chi2 = np.square(pixels).sum(axis=1) + np.square(depth)
    return np.where(points[:, 2] > 0.05, chi2, np.inf)


@numba.njit(cache=True, nogil=True)
def _accumulate(
    points, normals, pixels, sigmas, depths, depth_sigmas, is_used, T, camera, huber
):  # pragma: no cover - compiled
    """Normal equations of a camera twist. T maps the world to the camera.

    y = T X moves by -(rho + phi x y). The third residual is the distance of the measured point
    to the landmark's plane where its normal is known, else the difference in depth.
    """
    H = np.zeros((6, 6))
    b = np.zeros(6)
    J = np.zeros((3, 6))
    r = np.zeros(3)
    g = np.zeros((3, 3))
    lever = np.zeros((3, 3))
    cost = 0.0
    for n in range(len(points)):
        if not is_used[n]:
            continue
        X = points[n]
        x = T[0, 0] * X[0] + T[0, 1] * X[1] + T[0, 2] * X[2] + T[0, 3]
        y = T[1, 0] * X[0] + T[1, 1] * X[1] + T[1, 2] * X[2] + T[1, 3]
        z = T[2, 0] * X[0] + T[2, 1] * X[1] + T[2, 2] * X[2] + T[2, 3]
        if z < 0.05:
            continue
        g[:] = 0.0
        lever[:, 0], lever[:, 1], lever[:, 2] = x, y, z
        g[0, 0] = camera[0] / z / sigmas[n]
        g[0, 2] = -camera[0] * x / (z * z) / sigmas[n]
        g[1, 1] = camera[1] / z / sigmas[n]
        g[1, 2] = -camera[1] * y / (z * z) / sigmas[n]
        r[0] = (camera[0] * x / z + camera[2] - pixels[n, 0]) / sigmas[n]
        r[1] = (camera[1] * y / z + camera[3] - pixels[n, 1]) / sigmas[n]
        r[2] = 0.0
        d = depths[n]
        if d > 0.0:
            w = normals[n]
            mx = T[0, 0] * w[0] + T[0, 1] * w[1] + T[0, 2] * w[2]
            my = T[1, 0] * w[0] + T[1, 1] * w[1] + T[1, 2] * w[2]
            mz = T[2, 0] * w[0] + T[2, 1] * w[1] + T[2, 2] * w[2]
            has_normal = mx * mx + my * my + mz * mz > 0.5
            if not has_normal:
                mx, my, mz = 0.0, 0.0, 1.0
            ex = x - (pixels[n, 0] - camera[2]) / camera[0] * d
            ey = y - (pixels[n, 1] - camera[3]) / camera[1] * d
            r[2] = (mx * ex + my * ey + mz * (z - d)) / depth_sigmas[n]
            if has_normal:  # the measured point turns, not the landmark
                lever[2, 0], lever[2, 1], lever[2, 2] = x - ex, y - ey, d
            g[2, 0] = mx / depth_sigmas[n]
            g[2, 1] = my / depth_sigmas[n]
            g[2, 2] = mz / depth_sigmas[n]
        for k in range(3):
            gx, gy, gz = g[k, 0], g[k, 1], g[k, 2]
            J[k, 0], J[k, 1], J[k, 2] = -gx, -gy, -gz
            J[k, 3] = gy * lever[k, 2] - gz * lever[k, 1]
            J[k, 4] = gz * lever[k, 0] - gx * lever[k, 2]
            J[k, 5] = gx * lever[k, 1] - gy * lever[k, 0]
        error = np.sqrt(r[0] * r[0] + r[1] * r[1])
        weight = 1.0 if error <= huber else huber / error
        cost += error * error if error <= huber else 2.0 * huber * error - huber * huber
        plane = abs(r[2])
        weight_plane = 1.0 if plane <= huber else huber / plane
        cost += plane * plane if plane <= huber else 2.0 * huber * plane - huber * huber
        for k in range(3):
            s = weight if k < 2 else weight_plane
            for i in range(6):
                b[i] += s * J[k, i] * r[k]
                for j in range(i, 6):
                    H[i, j] += s * J[k, i] * J[k, j]
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return H, b, cost
