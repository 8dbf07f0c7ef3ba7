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
from shared.se3 import inverse, transform
from shared.tracks import Landmarks

_STILL = 1e-5  # metres and radians: a step that ends the iterations


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
    prior = (registration.T_world_camera, registration.information, registration.gradient)
    is_inlier = np.ones(len(observations.depths_m), np.bool_)
    for _ in range(config.rounds):
        T = _minimise(
            _arrays(observations),
            is_inlier,
            prior,
            T,
            camera,
            (config.huber_sigma, config.iterations),
        )
        is_inlier = _chi2(observations, T, camera) < config.outlier_chi2
    H, _, _ = linear_system(observations, is_inlier, T, camera, config)
    return Refinement(T, H + registration.information, is_inlier)


def _arrays(observations: PoseObservations) -> tuple[NDArray[np.float64], ...]:
    """What the kernels take, in their order."""
    o = observations
    return (
        o.points_world,
        o.normals_world,
        o.keypoints_px,
        o.pixel_sigmas,
        o.depths_m,
        o.depth_sigmas_m,
    )


def linear_system(
    observations: PoseObservations,
    is_used: NDArray[np.bool_],
    T: NDArray[np.float64],
    camera: NDArray[np.float64],
    config: RefinementConfig,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Normal equations (H, b) of a camera twist and the cost, whose gradient is 2 b."""
    return _accumulate(_arrays(observations), is_used, T, camera, config.huber_sigma)


def _chi2(
    observations: PoseObservations, T: NDArray[np.float64], camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Squared normalised error of each observation; infinite behind the camera."""
    points = transform(inverse(T), observations.points_world)
    z = np.maximum(points[:, 2], 1e-3)
    projected = camera[:2] * points[:, :2] / z[:, None] + camera[2:]
    pixels = (projected - observations.keypoints_px) / observations.pixel_sigmas[:, None]
    depth = (points[:, 2] - observations.depths_m) / observations.depth_sigmas_m
    depth = np.where(observations.depths_m > 0.0, depth, 0.0)
    chi2 = np.square(pixels).sum(axis=1) + np.square(depth)
    return np.where(points[:, 2] > 0.05, chi2, np.inf)


@numba.njit(cache=True, nogil=True)
def _minimise(  # noqa: PLR0913 - compiled
    observations, is_used, prior, T, camera, limits
):  # pragma: no cover - compiled
    """Levenberg-Marquardt; limits are (Huber's threshold, iterations)."""
    huber, iterations = limits
    T = T.copy()
    damping = 1e-6
    H, b, cost = _with_prior(observations, is_used, prior, T, camera, huber)
    for _ in range(iterations):
        damped = H.copy()
        for i in range(6):
            damped[i, i] += H[i, i] * damping + 1e-9
        twist = -np.linalg.solve(damped, b)
        T_new = T @ exp_twist(twist)
        H_new, b_new, cost_new = _with_prior(observations, is_used, prior, T_new, camera, huber)
        if cost_new > cost:
            damping *= 10.0
            continue
        T, H, b, cost, damping = T_new, H_new, b_new, cost_new, damping * 0.3
        if np.abs(twist).max() < _STILL:
            break
    return T


@numba.njit(cache=True, nogil=True)
def _with_prior(  # noqa: PLR0913 - compiled
    observations, is_used, prior, T, camera, huber
):  # pragma: no cover - compiled
    """Normal equations (H, b) and the cost of features and prior together."""
    H, b, cost = _accumulate(observations, is_used, T, camera, huber)
    T_prior, information, gradient = prior
    step = log_twist(inverse_rigid(T_prior) @ T)
    for i in range(6):
        pull = 0.0
        for j in range(6):
            pull += information[i, j] * step[j]
            H[i, j] += information[i, j]
        b[i] += pull + gradient[i]
        cost += step[i] * (pull + 2.0 * gradient[i])
    return H, b, cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(  # noqa: C901 - compiled
    observations, is_used, T, camera, huber
):  # pragma: no cover - compiled
    """Normal equations of a camera twist and the Huber cost."""
    points, normals, pixels, sigmas, depths, depth_sigmas = observations
    V = inverse_rigid(T)
    H = np.zeros((6, 6))
    b = np.zeros(6)
    J = np.zeros((3, 6))
    r = np.zeros(3)
    y = np.zeros(3)
    m = np.zeros(3)
    cost = 0.0
    for n in range(len(points)):
        if not is_used[n]:
            continue
        for i in range(3):
            y[i] = V[i, 3]
            m[i] = 0.0
            for j in range(3):
                y[i] += V[i, j] * points[n, j]
                m[i] += V[i, j] * normals[n, j]
        if y[2] < 0.05:
            continue
        _reprojection_rows(y, pixels[n], sigmas[n], camera, r, J)
        _plane_row((y, m), pixels[n], depths[n], camera, (r, J))
        r[2] /= depth_sigmas[n]
        for i in range(6):
            J[2, i] /= depth_sigmas[n]
        error = np.sqrt(r[0] * r[0] + r[1] * r[1])
        plane = abs(r[2])
        weight = 1.0 if error <= huber else huber / error
        weight_plane = 1.0 if plane <= huber else huber / plane
        cost += error * error if error <= huber else huber * (2.0 * error - huber)
        cost += plane * plane if plane <= huber else huber * (2.0 * plane - huber)
        for k in range(3):
            s = weight if k < 2 else weight_plane
            for i in range(6):
                scaled = s * J[k, i]
                b[i] += scaled * r[k]
                for j in range(i, 6):
                    H[i, j] += scaled * J[k, j]
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return H, b, cost


@numba.njit(cache=True, nogil=True)
def _reprojection_rows(y, pixel, sigma, camera, r, J):  # noqa: PLR0913 - compiled
    """Rows 0 and 1: y = T X moves by -(rho + phi x y)."""
    z = y[2]
    for k in range(2):
        r[k] = (camera[k] * y[k] / z + camera[2 + k] - pixel[k]) / sigma
    a, b = camera[0] / z / sigma, camera[1] / z / sigma
    _row((a, 0.0, -a * y[0] / z), (y[0], y[1], z), J[0])
    _row((0.0, b, -b * y[1] / z), (y[0], y[1], z), J[1])


@numba.njit(cache=True, nogil=True)
def _plane_row(landmark, pixel, depth, camera, out):  # pragma: no cover - compiled
    """Row 2, metres: the measured point's distance from the landmark's plane.

    Where no normal is known it is the difference in depth; without depth it is nothing.
    """
    y, normal = landmark
    r, J = out
    nx, ny, nz = normal[0], normal[1], normal[2]
    if depth <= 0.0:
        r[2] = 0.0
        _row((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), J[2])
    elif nx * nx + ny * ny + nz * nz < 0.5:
        r[2] = y[2] - depth
        _row((0.0, 0.0, 1.0), (y[0], y[1], y[2]), J[2])
    else:
        mx = (pixel[0] - camera[2]) / camera[0] * depth
        my = (pixel[1] - camera[3]) / camera[1] * depth
        r[2] = nx * (y[0] - mx) + ny * (y[1] - my) + nz * (y[2] - depth)
        # The plane stands still in the world: the measured point is what turns with the camera.
        _row((nx, ny, nz), (mx, my, depth), J[2])


@numba.njit(cache=True, nogil=True)
def _row(g, p, out):  # pragma: no cover - compiled
    """Derivative by a camera twist of g . p, where p = (x, y, z) moves by -(rho + phi x p)."""
    gx, gy, gz = g
    x, y, z = p
    out[0], out[1], out[2] = -gx, -gy, -gz
    out[3] = gy * z - gz * y
    out[4] = gz * x - gx * z
    out[5] = gx * y - gy * x
