"""Points and normals from the depth grid: no search for neighbours, no kd-tree."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import SurfaceConfig
from shared.camera import Intrinsics
from shared.tracks import PointCloud

BASE_PIXELS = 640 * 480
_SUMS = 9  # of xx, xy, yy, x, y, xr, yr, r, 1: x, y from the centre, r of the inverse depth


def surface_from_depth(
    depth_m: NDArray[np.float32], intrinsics: Intrinsics, config: SurfaceConfig
) -> PointCloud:
    """Sample a depth image on a grid and fit a plane to each sample's window.

    The inverse depth of a plane is linear in the pixel, and structured light measures inverse
    depth with even noise, so the fit is a small linear one (normal of the plane and a denoised
    point at once). Samples at edges, at grazing incidence or out of range are dropped.

    Args:
        depth_m: [H, W], 0 where there is none.
        intrinsics: pinhole of the image.
        config: grid, window, range.

    Returns:
        points and normals (towards the camera) in the camera frame, in rows of the grid.
    """
    stride, radius, camera, limits = _fit_settings(intrinsics, config)
    points, normals = _fit_planes(depth_m, camera, stride, radius, limits)
    return PointCloud(points, normals)


def normals_at(
    depth_m: NDArray[np.float32],
    pixels: NDArray[np.float32],
    intrinsics: Intrinsics,
    config: SurfaceConfig,
) -> NDArray[np.float32]:
    """Normals of the surface at some pixels [M, 2], camera frame, [M, 3]; zero where unknown."""
    _, radius, camera, limits = _fit_settings(intrinsics, config)
    return _fit_planes_at(depth_m, pixels, camera, radius, limits)


def _fit_settings(
    intrinsics: Intrinsics, config: SurfaceConfig
) -> tuple[int, int, NDArray[np.float64], NDArray[np.float64]]:
    """Stride and window radius in pixels of this image, its camera, and the limits."""
    scale = np.sqrt(intrinsics.width * intrinsics.height / BASE_PIXELS)
    stride = max(1, round(config.stride_px * scale))
    radius = max(3, round(config.window_radius_px * scale))
    camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    limits = np.array(
        [
            config.min_depth_m,
            config.max_depth_m,
            config.min_window_share,
            config.min_incidence_cos,
            config.max_slope,
        ]
    )
    return stride, radius, camera, limits


@numba.njit(cache=True, nogil=True)
def _fit_planes(depth, camera, stride, radius, limits):  # pragma: no cover - compiled
    """Row by row of the grid: the sums of a row's windows side by side, then its planes."""
    height, width = depth.shape
    columns = (width - stride // 2 - 1) // stride + 1
    capacity = ((height - 1) // stride + 1) * columns
    points = np.empty((capacity, 3), np.float32)
    normals = np.empty((capacity, 3), np.float32)
    count = 0
    for v in range(stride // 2, height, stride):
        sums = _row_sums(depth, v, (columns, stride, radius // 3), camera, limits)
        for k in range(columns):
            u = stride // 2 + k * stride
            z = depth[v, u]
            if not (limits[0] <= z <= limits[1]):
                continue
            inverse, nx, ny, nz = _solve_plane(sums[:, k], 1.0 / z, u, v, camera, limits)
            if inverse <= 0.0:
                continue
            points[count, 0] = (u - camera[2]) / camera[0] / inverse
            points[count, 1] = (v - camera[3]) / camera[1] / inverse
            points[count, 2] = 1.0 / inverse
            normals[count, 0], normals[count, 1], normals[count, 2] = nx, ny, nz
            count += 1
    return points[:count].copy(), normals[:count].copy()


@numba.njit(cache=True, nogil=True)
def _row_sums(depth, v, grid, camera, limits):  # pragma: no cover - compiled
    """Sums of `_SUMS` over the windows of one row of the grid, [9, columns].

    `grid` is the number of columns, the pixels between them and between the readings of a window.
    The loop over the samples is the inner one and has no branch, so that it becomes vectors; each
    sample still adds up its window in the order of `_fit_plane`, to the same bits.
    """
    height, width = depth.shape
    columns, stride, step = grid
    first = stride // 2
    sums = np.zeros((_SUMS, columns))
    z = depth[v, first::stride].copy()
    inverse, slope, tolerance = np.empty(columns), np.empty(columns), np.empty(columns)
    others, inverses = np.empty(columns, np.float32), np.empty(columns)
    for k in range(columns):
        inverse[k] = 1.0 / z[k] if z[k] > 0.0 else 0.0
        slope[k] = limits[4] * z[k] / camera[0]
        tolerance[k] = 0.005 * z[k] * z[k] + 0.002
    reach = 3 * step
    for vv in range(max(v - reach, v % step), min(v + reach + 1, height), step):
        for du in range(-reach, reach + 1, step):
            low = max(0, -((first + du) // stride))
            high = min(columns, (width - 1 - first - du) // stride + 1)
            others[:] = 0.0
            for k in range(low, high):
                others[k] = depth[vv, first + du + k * stride]
            for k in range(columns):
                inverses[k] = 1.0 / others[k] if others[k] > 0.0 else 0.0
            reach_px = max(abs(du), abs(vv - v))
            x, y = du * (1.0 / camera[0]), (vv - v) * (1.0 / camera[1])
            for k in range(columns):
                is_near = abs(others[k] - z[k]) <= slope[k] * reach_px + tolerance[k]
                w = 1.0 if others[k] > 0.0 and is_near else 0.0
                r = w * (inverses[k] - inverse[k])
                sums[0, k] += w * (x * x)
                sums[1, k] += w * (x * y)
                sums[2, k] += w * (y * y)
                sums[3, k] += w * x
                sums[4, k] += w * y
                sums[5, k] += x * r
                sums[6, k] += y * r
                sums[7, k] += r
                sums[8, k] += w
    return sums


@numba.njit(cache=True, nogil=True)
def _fit_planes_at(depth, pixels, camera, radius, limits):  # pragma: no cover - compiled
    normals = np.zeros((len(pixels), 3), np.float32)
    for n in range(len(pixels)):
        u = min(max(int(np.floor(pixels[n, 0] + 0.5)), 0), depth.shape[1] - 1)
        v = min(max(int(np.floor(pixels[n, 1] + 0.5)), 0), depth.shape[0] - 1)
        inverse, nx, ny, nz = _fit_plane(depth, u, v, camera, radius, limits)
        if inverse > 0.0:
            normals[n, 0], normals[n, 1], normals[n, 2] = nx, ny, nz
    return normals


@numba.njit(cache=True, nogil=True)
def _fit_plane(depth, u, v, camera, radius, limits):  # noqa: PLR0913 - compiled
    """Inverse depth (0: no plane) and unit normal at a pixel."""
    height, width = depth.shape
    fx, fy = camera[0], camera[1]
    none = (0.0, 0.0, 0.0, 0.0)
    z = depth[v, u]
    if not (limits[0] <= z <= limits[1]):
        return none
    step = radius // 3
    reach = 3 * step
    inverse = 1.0 / z
    # Divisions are what a window costs: all but one a pixel are done here.
    pixel_x, pixel_y, slope = 1.0 / fx, 1.0 / fy, limits[4] * z / fx
    tolerance = 0.005 * z * z + 0.002
    sums = np.zeros(_SUMS)
    for vv in range(max(v - reach, v % step), min(v + reach + 1, height), step):
        for uu in range(max(u - reach, u % step), min(u + reach + 1, width), step):
            other = depth[vv, uu]
            du, dv = uu - u, vv - v
            reach_px = max(abs(du), abs(dv))
            if other <= 0.0 or abs(other - z) > slope * reach_px + tolerance:
                continue
            x, y, r = du * pixel_x, dv * pixel_y, 1.0 / other - inverse
            sums[0], sums[1], sums[2] = sums[0] + x * x, sums[1] + x * y, sums[2] + y * y
            sums[3], sums[4], sums[7] = sums[3] + x, sums[4] + y, sums[7] + r
            sums[5], sums[6] = sums[5] + x * r, sums[6] + y * r
            sums[8] += 1.0
    return _solve_plane(sums, inverse, u, v, camera, limits)


@numba.njit(cache=True, nogil=True)
def _solve_plane(sums, inverse, u, v, camera, limits):  # noqa: PLR0913 - compiled
    """Inverse depth (0: no plane) and unit normal from the sums of 1/z = a x + b y + c."""
    none = (0.0, 0.0, 0.0, 0.0)
    sx, sy, sr, n = sums[3], sums[4], sums[7], sums[8]
    if n < limits[2] * 49:
        return none
    sxx, sxy, syy = sums[0] - sx * sx / n, sums[1] - sx * sy / n, sums[2] - sy * sy / n
    sxr, syr = sums[5] - sx * sr / n, sums[6] - sy * sr / n
    det = sxx * syy - sxy * sxy
    if det <= 1e-6 * sxx * syy:
        return none
    a = (syy * sxr - sxy * syr) / det
    b = (sxx * syr - sxy * sxr) / det
    c = inverse + (sr - a * sx - b * sy) / n
    x, y = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
    # (a, b, constant) . (x, y, 1) = 1/z with x and y from the image's principal point.
    constant = c - a * x - b * y
    length = np.sqrt(a * a + b * b + constant * constant)
    if c < limits[3] * length * np.sqrt(x * x + y * y + 1.0):
        return none
    return c, -a / length, -b / length, -constant / length
