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
    for index, level in enumerate(target.levels):
        T = _align_level(_every(source, config.sample_steps[index]), level, T, index, config)
    return linearise(source, target.levels[-1], orthonormalise(T), config)


def _every(cloud: PointCloud, step: int) -> PointCloud:
    return PointCloud(cloud.points[::step], cloud.normals[::step])


def _align_level(
    source: PointCloud,
    level: VoxelLevel,
    T: NDArray[np.float64],
    index: int,
    config: RegistrationConfig,
) -> NDArray[np.float64]:
    """Iterate on one level until it has no more to say than the next one will."""
    tolerance = config.tolerances[index]
    for _ in range(config.max_iterations[index]):
        H, b, _, _ = _normal_equations(source, level, T, config)
        twist = _well_determined_step(H, b, config.min_eigenvalue_share)
        T = T @ exp_twist(twist)
        if np.linalg.norm(twist[:3]) < tolerance and np.linalg.norm(twist[3:]) < tolerance:
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
    residuals, rows = _correspond(
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
    if len(residuals) < 30:
        return np.zeros((6, 6)), np.zeros(6), 0.0, 1.0
    scale = 1.4826 * float(np.median(np.abs(residuals)))
    width = max(config.kernel_width * scale, config.min_kernel_width)
    H, b = _accumulate(rows, residuals, width)
    return H, b, len(residuals) / len(source.points), scale


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
def _correspond(  # noqa: PLR0913 - compiled
    points, normals, T, size, keys, rows, map_points, map_normals, limits
):  # pragma: no cover - compiled
    """Residuals along the map's normal [M] and their rows of the Jacobian [M, 6], depth sigmas."""
    residuals = np.empty(len(points))
    rows_J = np.empty((len(points), 6))
    count = 0
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        mx, my, mz = normals[n, 0], normals[n, 1], normals[n, 2]
        nx = T[0, 0] * mx + T[0, 1] * my + T[0, 2] * mz
        ny = T[1, 0] * mx + T[1, 1] * my + T[1, 2] * mz
        nz = T[2, 0] * mx + T[2, 1] * my + T[2, 2] * mz
        found = _nearest_plane(
            x, y, z, nx, ny, nz, size, keys, rows, map_points, map_normals, limits[0]
        )
        if found < 0:
            continue
        wx, wy, wz = map_normals[found, 0], map_normals[found, 1], map_normals[found, 2]
        error = (
            (x - map_points[found, 0]) * wx
            + (y - map_points[found, 1]) * wy
            + (z - map_points[found, 2]) * wz
        )
        weight = 1.0 / (limits[1] + limits[2] * pz * pz)
        residuals[count] = weight * error
        gx = weight * (T[0, 0] * wx + T[1, 0] * wy + T[2, 0] * wz)
        gy = weight * (T[0, 1] * wx + T[1, 1] * wy + T[2, 1] * wz)
        gz = weight * (T[0, 2] * wx + T[1, 2] * wy + T[2, 2] * wz)
        J = rows_J[count]
        J[0], J[1], J[2] = gx, gy, gz
        J[3] = py * gz - pz * gy
        J[4] = pz * gx - px * gz
        J[5] = px * gy - py * gx
        count += 1
    return residuals[:count], rows_J[:count]


@numba.njit(cache=True, nogil=True)
def _nearest_plane(  # noqa: PLR0913 - compiled
    x, y, z, nx, ny, nz, size, keys, rows, map_points, map_normals, min_cosine
):  # pragma: no cover - compiled
    """Row of the nearest plane that faces as the point does, within a voxel's side; -1: none."""
    cell_x, step_x, reach_x = _cell_and_neighbour(x, size)
    cell_y, step_y, reach_y = _cell_and_neighbour(y, size)
    cell_z, step_z, reach_z = _cell_and_neighbour(z, size)
    first = main_axis(nx, ny, nz)
    second = _second_axis(nx, ny, nz, first)
    best = size * size
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
            distance = (
                (x - map_points[row, 0]) ** 2
                + (y - map_points[row, 1]) ** 2
                + (z - map_points[row, 2]) ** 2
            )
            if distance >= best:
                continue
            cosine = nx * map_normals[row, 0] + ny * map_normals[row, 1] + nz * map_normals[row, 2]
            if cosine >= min_cosine:
                best = distance
                found = row
    return found


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
def _accumulate(rows, residuals, width):  # pragma: no cover - compiled
    """Normal equations with the Geman-McClure weight."""
    H = np.zeros((6, 6))
    b = np.zeros(6)
    for n in range(len(residuals)):
        weight = 1.0 / (1.0 + (residuals[n] / width) ** 2) ** 2
        for i in range(6):
            scaled = weight * rows[n, i]
            b[i] += scaled * residuals[n]
            for j in range(i, 6):
                H[i, j] += scaled * rows[n, j]
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return H, b
