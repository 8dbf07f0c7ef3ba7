"""Depth for a new keyframe's pixels that the sensor left out, in no other keyframe's free space.

The first guess is the depth around a hole, and of the landmarks in it. Where other keyframes look
through that point at something behind it, the guess would hang before what they see: it goes
further along its ray, until no keyframe looks through it any more.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from services.mapping.anchors.depth_fill import filled_depth
from services.mapping.anchors.seeding import SeedRequest
from services.mapping.config import AnchorConfig
from services.mapping.views.sightings import CoarseDepths, Sightings
from services.mapping.views.training_views import TrainingView
from shared import se3

_FURTHER = (1.0, 1.2, 1.5, 2.0)  # times the first guess; beyond the last, there is none
_NEAREST_M = 0.1
_AROUND = 7  # landmarks, the one in question among them
_STEP_PX = 4  # of a row and column, between the pixels that are looked at
_PROBE_STEP = 24  # of those, between the points that keyframes are chosen by


def with_guesses(
    request: SeedRequest, sightings: Sightings, keyframes: list[TrainingView], config: AnchorConfig
) -> SeedRequest:
    """The request with guesses for the depth that its image lacks; 0 stays where none fits.

    Args:
        request: a new keyframe's.
        sightings: what the keyframes measured.
        keyframes: all of the map.
        config: whether to guess; how far behind a point a reading is that looks through it.
    """
    if not config.fill_holes:
        return request
    image, T_world_camera, camera = request.image, request.T_world_camera, request.image.intrinsics
    filled_m = filled_depth(_with_landmarks(request))
    if image.moving is not None:  # what is behind is not guessed
        filled_m = np.where(image.moving, np.float32(0.0), filled_m)
    grid = slice(_STEP_PX // 2, None, _STEP_PX)
    rows, columns = np.nonzero((image.depth_m[grid, grid] == 0) & (filled_m[grid, grid] > 0))
    if len(rows) == 0:
        return _with_depth(request, filled_m)
    v, u = rows * _STEP_PX + _STEP_PX // 2, columns * _STEP_PX + _STEP_PX // 2
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], 1)
    points = rays * filled_m[v, u][:, None]
    probes = se3.transform(T_world_camera, points[::_PROBE_STEP])
    depths = sightings.coarse_depths(sightings.facing(probes, keyframes))
    factors = np.ones(filled_m[grid, grid].shape, np.float32)
    factors[rows, columns] = _factors(points, T_world_camera, depths, config)
    guesses_m = filled_m * _spread(factors, filled_m.shape)
    return _with_depth(request, np.where(image.depth_m > 0, image.depth_m, guesses_m))


def _with_depth(request: SeedRequest, depth_m: NDArray[np.float32]) -> SeedRequest:
    return replace(request, image=replace(request.image, depth_m=depth_m))


def _with_landmarks(request: SeedRequest) -> NDArray[np.float32]:
    """The depth image with that of the keyframe's landmarks where it has none, [H, W]."""
    image, i = request.image, request.image.intrinsics
    points = se3.transform(se3.inverse(request.T_world_camera), request.landmarks_world)
    points = points[points[:, 2] > _NEAREST_M]
    pixels = points[:, :2] / points[:, 2:] * [i.fx, i.fy] + [i.cx + 0.5, i.cy + 0.5]
    u, v = np.floor(pixels).astype(np.int64).T
    inside = np.flatnonzero((u >= 0) & (v >= 0) & (u < i.width) & (v < i.height))
    kept = inside[image.depth_m[v[inside], u[inside]] == 0]
    depth_m = image.depth_m.copy()
    depth_m[v[kept], u[kept]] = _usual_depths(pixels[kept], points[kept, 2])
    return depth_m


def _usual_depths(pixels: NDArray[np.float64], depths_m: NDArray[np.float64]) -> NDArray:
    """The median of each landmark [L] and those around it: one in four may be of something else."""
    if len(pixels) < _AROUND:
        return depths_m
    _, around = KDTree(pixels).query(pixels, _AROUND)
    return np.median(depths_m[around], axis=1)


def _spread(factors: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The factors of the grid, for every pixel of an image of that shape, [H, W]."""
    spread = factors.repeat(_STEP_PX, axis=0).repeat(_STEP_PX, axis=1)
    missing = [(0, max(0, want - got)) for want, got in zip(shape, spread.shape, strict=True)]
    return np.pad(spread, missing, mode="edge")[: shape[0], : shape[1]]


def _factors(
    points: NDArray[np.floating],
    T_world_camera: NDArray[np.float64],
    depths: CoarseDepths,
    config: AnchorConfig,
) -> NDArray[np.float32]:
    """The least of `_FURTHER` that nobody looks through, of points [P, 3] of a camera; or 0."""
    factors, open_ = np.zeros(len(points), np.float32), np.arange(len(points))
    gap = config.min_depth_gap, config.min_depth_gap_m
    for factor in _FURTHER:
        world = se3.transform(T_world_camera, points[open_] * factor)
        is_through = np.zeros(len(open_), bool)
        look_through(world, depths, gap, is_through)
        factors[open_[~is_through]] = factor
        open_ = open_[is_through]
    return factors


@numba.njit(cache=True, nogil=True, error_model="numpy")
def look_through(points, keyframes, gap, is_through):  # pragma: no cover - compiled
    """`is_through` [P]: all 3 x 3 readings of a keyframe around a point [P, 3] are well behind it.

    `keyframes` are `CoarseDepths`; well behind is by a share and a length in metres, `gap`.
    """
    T, depths_mm, (fx, fy, cx, cy, step) = keyframes
    share, length_m = gap
    half = step // 2
    for p in range(points.shape[0]):
        x, y, z = points[p]
        for i in range(T.shape[0]):
            zc = T[i, 2, 0] * x + T[i, 2, 1] * y + T[i, 2, 2] * z + T[i, 2, 3]
            if zc < 0.2:
                continue
            xc = T[i, 0, 0] * x + T[i, 0, 1] * y + T[i, 0, 2] * z + T[i, 0, 3]
            yc = T[i, 1, 0] * x + T[i, 1, 1] * y + T[i, 1, 2] * z + T[i, 1, 3]
            column = int(np.floor((fx * xc / zc + cx - half) / step + 0.5))
            row = int(np.floor((fy * yc / zc + cy - half) / step + 0.5))
            if row < 1 or column < 1:
                continue
            if row + 1 >= depths_mm.shape[1] or column + 1 >= depths_mm.shape[2]:
                continue
            around = depths_mm[i, row - 1 : row + 2, column - 1 : column + 2]
            if around.min() > 1000.0 * (zc * (1.0 + share) + length_m):
                is_through[p] = True
                break
