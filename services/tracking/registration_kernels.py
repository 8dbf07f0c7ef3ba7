"""Compiled loops of the registration; `registration.py` says what they are for.

A source is (points [N, 3], normals [N, 3]) of the camera frame, a level (voxel size, keys, rows,
planes [V, 6]) as in `VoxelLevel`, limits are (least cosine between normals, floor of the depth
sigma, its growth with squared depth). Residuals and Jacobians are in depth sigmas.
"""

from __future__ import annotations

import numba
import numpy as np

from services.tracking.twists import exp_twist
from services.tracking.voxel_map import cell_key, find_slot

MIN_CORRESPONDENCES = 30


@numba.njit(cache=True, nogil=True)
def descend(source, level, T, limits, kernel, stop):  # noqa: PLR0913 - compiled
    """Gauss-Newton steps on one level, T_world_camera after the last.

    `kernel` is its width in residual scales and its least width; `stop` the iterations, the step
    that ends them and the share below which an eigenvalue counts as nothing.
    """
    for _ in range(int(stop[0])):
        points, planes, residuals = correspond(source, level, T, limits)
        if len(points) < MIN_CORRESPONDENCES:
            break
        width = max(kernel[0] * residual_scale(residuals), kernel[1])
        found = (points, planes, residuals)
        H, _, b = accumulate(source, level, (T, limits, width), found, False)
        twist = _known_step(H, b, stop[2])
        T = T @ exp_twist(twist)
        if np.linalg.norm(twist[:3]) < stop[1] and np.linalg.norm(twist[3:]) < stop[1]:
            break
    return T


@numba.njit(cache=True, nogil=True)
def _known_step(H, b, min_share):  # pragma: no cover - compiled
    """Gauss-Newton step without the directions that nothing holds (Zhang et al., ICRA 2016)."""
    values, vectors = np.linalg.eigh(H)
    step = np.zeros(6)
    for k in range(6):
        if values[k] > min_share * max(values[5], 1e-12):
            along = 0.0
            for i in range(6):
                along += vectors[i, k] * b[i]
            for i in range(6):
                step[i] -= along / values[k] * vectors[i, k]
    return step


@numba.njit(cache=True, nogil=True)
def residual_scale(residuals):  # pragma: no cover - compiled
    """Robust standard deviation."""
    return 1.4826 * np.median(np.abs(residuals))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def correspond(source, level, T, limits):  # pragma: no cover - compiled
    """Rows of points [M], of the planes nearest to them [M], and distances [M] in sigmas."""
    points, normals = source
    planes = level[3]
    found_points = np.empty(len(points), np.int64)
    found_planes = np.empty(len(points), np.int64)
    residuals = np.empty(len(points))
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
        row = _nearest_plane((x, y, z), (nx, ny, nz), level, limits[0])
        if row < 0:
            continue
        q = planes[row]
        error = (x - q[0]) * q[3] + (y - q[1]) * q[4] + (z - q[2]) * q[5]
        found_points[count] = n
        found_planes[count] = row
        residuals[count] = error / (limits[1] + limits[2] * pz * pz)
        count += 1
    return found_points[:count], found_planes[:count], residuals[:count]


@numba.njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _nearest_plane(point, normal, level, min_cosine):  # pragma: no cover - compiled
    """Row of the nearest plane that faces as the point does, within a voxel's side; -1: none."""
    x, y, z = point
    nx, ny, nz = normal
    size, keys, rows, planes = level
    cell_x, step_x, reach_x = _cell_and_neighbour(x, size)
    cell_y, step_y, reach_y = _cell_and_neighbour(y, size)
    cell_z, step_z, reach_z = _cell_and_neighbour(z, size)
    first, second = _axes(nx, ny, nz)
    best = size * size
    found = np.int64(-1)
    for turn in range(2 if second >= 0 else 1):
        direction = first if turn == 0 else second
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
            dx, dy, dz = x - planes[row, 0], y - planes[row, 1], z - planes[row, 2]
            distance = dx * dx + dy * dy + dz * dz
            if distance >= best:
                continue
            if nx * planes[row, 3] + ny * planes[row, 4] + nz * planes[row, 5] >= min_cosine:
                best = distance
                found = np.int64(row)
    return found


@numba.njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _cell_and_neighbour(x, size):  # pragma: no cover - compiled
    """The cell of a coordinate, the step to the nearer neighbour, and its squared distance."""
    cell = np.floor(x / size)
    rest = x - cell * size
    if rest > 0.5 * size:
        return np.int64(cell), 1, (size - rest) ** 2
    return np.int64(cell), -1, rest**2


@numba.njit(cache=True, nogil=True, inline="always")
def _axes(x, y, z):  # pragma: no cover - compiled
    """The axis direction nearest to a normal; the next one where it is nearly as near, else -1."""
    ax, ay, az = abs(x), abs(y), abs(z)
    along_x, along_y, along_z = 1 if x > 0.0 else 0, 3 if y > 0.0 else 2, 5 if z > 0.0 else 4
    if ax >= ay and ax >= az:
        first, largest = along_x, ax
        second, next_largest = (along_y, ay) if ay >= az else (along_z, az)
    elif ay >= az:
        first, largest = along_y, ay
        second, next_largest = (along_x, ax) if ax >= az else (along_z, az)
    else:
        first, largest = along_z, az
        second, next_largest = (along_x, ax) if ax >= ay else (along_y, ay)
    return first, second if next_largest >= 0.8 * largest else -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def accumulate(source, level, at, found, with_signal):  # pragma: no cover - compiled
    """Normal equations with the Geman-McClure weight, and what of H the normals of both say.

    `at` is the pose T_world_camera, the limits and the kernel's width. The signal stays zero unless
    it is asked for.
    """
    T, limits, width = at
    points, normals = source
    planes = level[3]
    H, signal, b = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    J, own = np.zeros(6), np.zeros(6)
    for k in range(len(found[0])):
        n, row, residual = found[0][k], found[1][k], found[2][k]
        p, q, m = points[n], planes[row], normals[n]
        sigma = limits[1] + limits[2] * p[2] * p[2]
        gx = (T[0, 0] * q[3] + T[1, 0] * q[4] + T[2, 0] * q[5]) / sigma
        gy = (T[0, 1] * q[3] + T[1, 1] * q[4] + T[2, 1] * q[5]) / sigma
        gz = (T[0, 2] * q[3] + T[1, 2] * q[4] + T[2, 2] * q[5]) / sigma
        _jacobian(p, (gx, gy, gz), J)
        weight = 1.0 / (1.0 + (residual / width) ** 2) ** 2
        for i in range(6):
            scaled = weight * J[i]
            b[i] += scaled * residual
            for j in range(i, 6):
                H[i, j] += scaled * J[j]
        if with_signal:
            _jacobian(p, (m[0] / sigma, m[1] / sigma, m[2] / sigma), own)
            for i in range(6):
                for j in range(i, 6):
                    signal[i, j] += 0.5 * weight * (J[i] * own[j] + own[i] * J[j])
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
            signal[i, j] = signal[j, i]
    return H, signal, b


@numba.njit(cache=True, nogil=True, inline="always")
def _jacobian(p, g, out):  # pragma: no cover - compiled
    """Derivative by a camera twist of g . p, the world at rest."""
    px, py, pz = p[0], p[1], p[2]
    gx, gy, gz = g
    out[0], out[1], out[2] = gx, gy, gz
    out[3] = py * gz - pz * gy
    out[4] = pz * gx - px * gz
    out[5] = px * gy - py * gx
