"""Coarse pose: robust point-to-plane registration of a frame's surface to the local map.

Each source point looks for the nearest plane among the eight voxels around it that face its way
(Rusinkiewicz and Levoy, 3DIM 2001, for the variants; Segal et al., RSS 2009, for the metric: with
normals on both sides GICP weighs the distance along the normal, which is what is left of it
here). Increments are twists (rho, phi) in the camera frame: `T_world_camera @ exp(twist)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import RegistrationConfig
from services.tracking.twists import exp_twist
from services.tracking.voxel_map import VoxelLevel, VoxelMap, cell_key, find_slot, main_axis
from shared.se3 import orthonormalise
from shared.tracks import PointCloud


@dataclass(frozen=True)
class Registration:
    """A registered pose, and how the cost looks around it: `information` of a camera twist."""

    T_world_camera: NDArray[np.float64]  # [4, 4]
    information: NDArray[np.float64]  # [6, 6]
    gradient: NDArray[np.float64]  # [6], half that of the cost, at this pose
    overlap: float  # share of the source that has a plane in the map
    residual_scale: float  # in depth sigmas


def align(
    source: PointCloud,
    target: VoxelMap,
    T_world_camera: NDArray[np.float64],
    config: RegistrationConfig,
) -> Registration:
    """Register a cloud of the camera frame to the map, coarse to fine.

    Args:
        source: camera frame, normals towards the camera.
        target: levels of the config's voxel sizes.
        T_world_camera: where to start, [4, 4].
        config: levels, kernel, tolerances.
    """
    T = T_world_camera
    levels = zip(target.levels, config.sample_steps, config.max_iterations, strict=True)
    for level, step, iterations in levels:
        T = _align_level(_every(source, step), level, T, iterations, config)
    return linearise(source, target.levels[-1], orthonormalise(T), config)


def _every(cloud: PointCloud, step: int) -> PointCloud:
    return PointCloud(cloud.points[::step], cloud.normals[::step])


def _align_level(
    source: PointCloud,
    level: VoxelLevel,
    T: NDArray[np.float64],
    iterations: int,
    config: RegistrationConfig,
) -> NDArray[np.float64]:
    for _ in range(iterations):
        H, b, _, _ = _normal_equations(source, level, T, config)
        twist = _well_determined_step(H, b, config.min_eigenvalue_share)
        T = T @ exp_twist(twist)
        if (
            np.linalg.norm(twist[:3]) < config.translation_tolerance_m
            and np.linalg.norm(twist[3:]) < config.rotation_tolerance_rad
        ):
            break
    return T


def linearise(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> Registration:
    """The registration's cost around a pose, without a step."""
    step = config.sample_steps[-1]
    H, b, overlap, scale = _normal_equations(_every(source, step), level, T, config)
    sigma = max(scale, config.model_sigma)
    factor = step * config.effective_share / sigma**2
    return Registration(T, factor * H, factor * b, overlap, scale)


def optimum(registration: Registration, config: RegistrationConfig) -> NDArray[np.float64]:
    """The pose where a linearised registration has its minimum, T_world_camera."""
    step = _well_determined_step(
        registration.information, registration.gradient, config.min_eigenvalue_share
    )
    return registration.T_world_camera @ exp_twist(step)


def _normal_equations(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Hessian, gradient (in depth sigmas), overlap and residual scale at a pose."""
    residuals, directions = _correspond(
        source.points,
        source.normals,
        T,
        level.voxel_size_m,
        level.keys,
        level.rows,
        level.points,
        level.normals,
        np.array([config.min_normal_cos, config.depth_sigma_floor_m, config.depth_sigma_per_m2]),
    )
    found = np.flatnonzero(np.isfinite(residuals))
    if len(found) < 30:
        return np.zeros((6, 6)), np.zeros(6), 0.0, 1.0
    scale = 1.4826 * float(np.median(np.abs(residuals[found])))
    width = max(config.kernel_width * scale, config.min_kernel_width)
    H, b = _accumulate(source.points, directions, residuals, found, width)
    return H, b, len(found) / len(source.points), scale


def _well_determined_step(
    H: NDArray[np.float64], b: NDArray[np.float64], min_share: float
) -> NDArray[np.float64]:
    """Gauss-Newton step without the directions that the geometry leaves open (Zhang, ICRA 2016)."""
    values, vectors = np.linalg.eigh(H)
    keep = values > min_share * max(values[-1], 1e-12)
    if not keep.any():
        return np.zeros(6)
    basis = vectors[:, keep]
    return -basis @ ((basis.T @ b) / values[keep])


@numba.njit(cache=True, nogil=True)
def _correspond(  # noqa: C901, PLR0913 - compiled
    points, normals, T, size, keys, rows, map_points, map_normals, limits
):  # pragma: no cover - compiled
    """Residual along the map's normal in depth sigmas (NaN: none) and J's first half, scaled."""
    count = len(points)
    residuals = np.full(count, np.nan)
    directions = np.zeros((count, 3))
    for n in range(count):
        p, m = points[n], normals[n]
        x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        nx = T[0, 0] * m[0] + T[0, 1] * m[1] + T[0, 2] * m[2]
        ny = T[1, 0] * m[0] + T[1, 1] * m[1] + T[1, 2] * m[2]
        nz = T[2, 0] * m[0] + T[2, 1] * m[1] + T[2, 2] * m[2]
        cell_x, step_x, reach_x = _cell_and_neighbour(x, size)
        cell_y, step_y, reach_y = _cell_and_neighbour(y, size)
        cell_z, step_z, reach_z = _cell_and_neighbour(z, size)
        first = main_axis(nx, ny, nz)
        second = _second_axis(nx, ny, nz, first)
        best = np.inf
        found = -1
        for turn in range(2):
            direction = first if turn == 0 else second
            if direction < 0:
                break
            for corner in range(8):
                bx, by, bz = corner & 1, (corner >> 1) & 1, corner >> 2
                if bx * reach_x + by * reach_y + bz * reach_z >= best:
                    continue  # nothing in that voxel can be nearer
                key = cell_key(
                    direction, cell_x + bx * step_x, cell_y + by * step_y, cell_z + bz * step_z
                )
                slot = find_slot(keys, key)
                if keys[slot] == -1:
                    continue
                row = rows[slot]
                q, w = map_points[row], map_normals[row]
                if nx * w[0] + ny * w[1] + nz * w[2] < limits[0]:
                    continue
                distance = (x - q[0]) ** 2 + (y - q[1]) ** 2 + (z - q[2]) ** 2
                if distance < best:
                    best = distance
                    found = row
        if found < 0 or best > size * size:
            continue
        q, w = map_points[found], map_normals[found]
        sigma = limits[1] + limits[2] * p[2] * p[2]
        residuals[n] = ((x - q[0]) * w[0] + (y - q[1]) * w[1] + (z - q[2]) * w[2]) / sigma
        for axis in range(3):
            directions[n, axis] = (
                T[0, axis] * w[0] + T[1, axis] * w[1] + T[2, axis] * w[2]
            ) / sigma
    return residuals, directions


@numba.njit(cache=True, nogil=True, inline="always")
def _cell_and_neighbour(x, size):  # pragma: no cover - compiled
    """The cell of a coordinate, the step to the nearer neighbour, and its squared distance."""
    cell = np.floor(x / size)
    rest = x - cell * size
    if rest > 0.5 * size:
        return np.int64(cell), 1, (size - rest) ** 2
    return np.int64(cell), -1, rest**2


@numba.njit(cache=True, nogil=True, inline="always")
def _second_axis(x, y, z, first):  # pragma: no cover - compiled
    """The next axis direction where it is nearly as close as the first, else -1."""
    values = (x, y, z)
    largest = abs(values[first >> 1])
    best = 0.0
    axis = -1
    for i in range(3):
        if i != first >> 1 and abs(values[i]) > best:
            best = abs(values[i])
            axis = i
    if best < 0.8 * largest:
        return -1
    return 2 * axis + (1 if values[axis] > 0.0 else 0)


@numba.njit(cache=True, nogil=True)
def _accumulate(points, directions, residuals, found, width):  # pragma: no cover - compiled
    """Normal equations with the Geman-McClure weight."""
    H = np.zeros((6, 6))
    b = np.zeros(6)
    J = np.zeros(6)
    for n in found:
        p, m = points[n], directions[n]
        J[0], J[1], J[2] = m[0], m[1], m[2]
        J[3] = p[1] * m[2] - p[2] * m[1]
        J[4] = p[2] * m[0] - p[0] * m[2]
        J[5] = p[0] * m[1] - p[1] * m[0]
        weight = 1.0 / (1.0 + (residuals[n] / width) ** 2) ** 2
        for i in range(6):
            b[i] += weight * J[i] * residuals[n]
            for j in range(i, 6):
                H[i, j] += weight * J[i] * J[j]
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return H, b
