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
from services.tracking.normal_equations import NormalEquations, known_directions
from services.tracking.twists import exp_twist, inverse_rigid, log_twist
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
    return _without_slide(source, target.levels[-1], orthonormalise(T), T_world_camera, config)


def _without_slide(
    source: PointCloud,
    level: VoxelLevel,
    T: NDArray[np.float64],
    T_start: NDArray[np.float64],
    config: RegistrationConfig,
) -> Registration:
    """At a registered pose, but back at the start along what the geometry leaves open.

    Only here: on the way the normals differ because the pose is off, not because of noise.
    """
    equations = _finest_equations(source, level, T, config)
    back = log_twist(inverse_rigid(T) @ T_start)
    slide = back - equations.projector(config.min_eigenvalue_share) @ back
    if np.linalg.norm(slide) < config.tolerances[-1]:
        return _registration(T, equations, config)
    return linearise(source, level, T @ exp_twist(slide), config)


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
        equations = _normal_equations(source, level, T, config)
        twist = equations.step(config.min_eigenvalue_share)
        T = T @ exp_twist(twist)
        if np.linalg.norm(twist[:3]) < tolerance and np.linalg.norm(twist[3:]) < tolerance:
            break
    return T


def linearise(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> Registration:
    """The registration's cost around a pose, without a step."""
    return _registration(T, _finest_equations(source, level, T, config), config)


def _finest_equations(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> NormalEquations:
    return _normal_equations(_every(source, config.sample_steps[-1]), level, T, config)


def _registration(
    T: NDArray[np.float64], equations: NormalEquations, config: RegistrationConfig
) -> Registration:
    """In units of what is independent, of the directions that the geometry holds."""
    known = equations.projector(config.min_eigenvalue_share)
    sigma = max(equations.residual_scale, config.model_sigma)
    factor = config.sample_steps[-1] * config.effective_share / sigma**2
    return Registration(
        T,
        factor * known.T @ equations.H @ known,
        factor * known.T @ equations.b,
        equations.overlap,
        equations.residual_scale,
    )


def optimum(registration: Registration, config: RegistrationConfig) -> NDArray[np.float64]:
    """The pose where a linearised registration has its minimum, T_world_camera."""
    H, share = registration.information, config.min_eigenvalue_share
    basis = known_directions(H, H, share)
    return registration.T_world_camera @ exp_twist(-basis @ (basis.T @ registration.gradient))


def _normal_equations(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> NormalEquations:
    """The system of the robust cost at a pose; empty where hardly anything corresponds."""
    residuals, rows, own_rows = _correspond(
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
        return NormalEquations(np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), 0.0, 1.0)
    scale = 1.4826 * float(np.median(np.abs(residuals)))
    width = max(config.kernel_width * scale, config.min_kernel_width)
    H, signal, b = _accumulate(rows, own_rows, residuals, width)
    return NormalEquations(H, signal, b, len(residuals) / len(source.points), scale)


@numba.njit(cache=True, nogil=True)
def _correspond(  # noqa: PLR0913 - compiled
    points, normals, T, size, keys, rows, map_points, map_normals, limits
):  # pragma: no cover - compiled
    """Residuals along the map's normals [M] and their Jacobian [M, 6], in depth sigmas.

    Third, the Jacobian [M, 6] that the points' own normals would give.
    """
    residuals = np.empty(len(points))
    rows_J = np.empty((len(points), 6))
    rows_own = np.empty((len(points), 6))
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
        _jacobian(px, py, pz, gx, gy, gz, rows_J[count])
        _jacobian(px, py, pz, weight * mx, weight * my, weight * mz, rows_own[count])
        count += 1
    return residuals[:count], rows_J[:count], rows_own[:count]


@numba.njit(cache=True, nogil=True, inline="always")
def _jacobian(px, py, pz, gx, gy, gz, out):  # noqa: PLR0913 - compiled
    """Derivative by a camera twist of g . p, the world at rest."""
    out[0], out[1], out[2] = gx, gy, gz
    out[3] = py * gz - pz * gy
    out[4] = pz * gx - px * gz
    out[5] = px * gy - py * gx


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
def _accumulate(rows, own_rows, residuals, width):  # pragma: no cover - compiled
    """Normal equations with the Geman-McClure weight; between them the signal in H."""
    H = np.zeros((6, 6))
    signal = np.zeros((6, 6))
    b = np.zeros(6)
    for n in range(len(residuals)):
        weight = 1.0 / (1.0 + (residuals[n] / width) ** 2) ** 2
        for i in range(6):
            scaled, own = weight * rows[n, i], weight * own_rows[n, i]
            b[i] += scaled * residuals[n]
            for j in range(i, 6):
                H[i, j] += scaled * rows[n, j]
                signal[i, j] += 0.5 * (scaled * own_rows[n, j] + own * rows[n, j])
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
            signal[i, j] = signal[j, i]
    return H, signal, b
