"""Pictures and exact depth of a packed scene: a z-buffer of rectangles, then textures.

Colour is drawn at twice the resolution and averaged; depth is that of the ray through the pixel's
centre.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pointslam.synth.scene import MIP_LEVELS, Scene
from pointslam.synth.textures import TEXEL_M
from shared import se3
from shared.camera import Intrinsics
from shared.se3 import Matrix

_NEAR_M = 0.05
_SUPERSAMPLING = 2


def render_depth(
    scene: Scene, T_world_camera: Matrix, camera: Intrinsics
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth along the optical axis, metres, and the cosine of incidence, both [H, W]."""
    quads, depth, index = _visible(scene, T_world_camera, camera)
    cosine = np.zeros_like(depth)
    _incidence(quads, index, _pinhole(camera), cosine)
    return depth, cosine


def render_colour(scene: Scene, T_world_camera: Matrix, camera: Intrinsics) -> NDArray[np.float32]:
    """The picture, RGB from 0 to 255, [H, W, 3], not rounded."""
    fine = camera.scaled(_SUPERSAMPLING)
    quads, depth, index = _visible(scene, T_world_camera, fine)
    out = np.zeros((camera.height, camera.width, 3), np.float32)
    textures = (scene.texels, scene.offsets, scene.shapes)
    _texture(quads, (depth, index), _pinhole(fine), textures, out)
    return out


def _visible(
    scene: Scene, T_world_camera: Matrix, camera: Intrinsics
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]]:
    """The rectangles in camera coordinates, and depth and index of the nearest, [H, W]."""
    quads = _to_camera(scene.geometry, se3.inverse(T_world_camera))
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    index = np.full((camera.height, camera.width), -1, np.int32)
    _rasterise(quads, _pinhole(camera), depth, index)
    depth[index < 0] = 0.0
    return quads, depth, index


def _pinhole(camera: Intrinsics) -> NDArray[np.float64]:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


def _to_camera(geometry: NDArray[np.float64], T_camera_world: Matrix) -> NDArray[np.float64]:
    quads = geometry.copy()
    quads[:, :3] = se3.transform(T_camera_world, geometry[:, :3])
    for start in (3, 6, 9):
        quads[:, start : start + 3] = se3.rotate(T_camera_world, geometry[:, start : start + 3])
    return quads


@numba.njit(cache=True, nogil=True)
def _bounds(quad, pinhole, shape):  # pragma: no cover - compiled
    """Pixel rectangle [u0, u1) x [v0, v1) that holds the projection of a rectangle."""
    height, width = shape
    u0, v0, u1, v1 = 1e9, 1e9, -1e9, -1e9
    behind = 0
    for corner in range(4):
        a = quad[12] if corner & 1 else 0.0
        b = quad[13] if corner & 2 else 0.0
        z = quad[2] + a * quad[5] + b * quad[8]
        if z < _NEAR_M:
            behind += 1
            continue
        u = (quad[0] + a * quad[3] + b * quad[6]) / z * pinhole[0] + pinhole[2]
        v = (quad[1] + a * quad[4] + b * quad[7]) / z * pinhole[1] + pinhole[3]
        u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    if behind == 4:
        return 0, 0, 0, 0
    if behind > 0:  # it reaches behind the camera: anywhere in the picture
        return 0, width, 0, height
    u0, v0 = max(u0, 0.0), max(v0, 0.0)
    return int(u0), min(int(u1) + 2, width), int(v0), min(int(v1) + 2, height)


@numba.njit(cache=True, nogil=True)
def _rasterise(quads, pinhole, depth, index):  # pragma: no cover - compiled
    """Keep the nearest rectangle of every pixel's ray."""
    for q in range(len(quads)):
        g = quads[q]
        plane = g[0] * g[9] + g[1] * g[10] + g[2] * g[11]
        if plane >= 0.0:  # we are behind it
            continue
        u0, u1, v0, v1 = _bounds(g, pinhole, depth.shape)
        right_origin = g[0] * g[3] + g[1] * g[4] + g[2] * g[5]
        down_origin = g[0] * g[6] + g[1] * g[7] + g[2] * g[8]
        for v in range(v0, v1):
            y = (v - pinhole[3]) / pinhole[1]
            for u in range(u0, u1):
                x = (u - pinhole[2]) / pinhole[0]
                slope = x * g[9] + y * g[10] + g[11]
                if slope >= -1e-9:
                    continue
                z = plane / slope
                if z >= depth[v, u] or z < _NEAR_M:
                    continue
                across = z * (x * g[3] + y * g[4] + g[5]) - right_origin
                down = z * (x * g[6] + y * g[7] + g[8]) - down_origin
                if 0.0 <= across <= g[12] and 0.0 <= down <= g[13]:
                    depth[v, u] = z
                    index[v, u] = q


@numba.njit(cache=True, nogil=True)
def _cosine(g, x, y):  # pragma: no cover - compiled
    """Cosine between a rectangle's normal and the ray (x, y, 1)."""
    return -(x * g[9] + y * g[10] + g[11]) / np.sqrt(x * x + y * y + 1.0)


@numba.njit(cache=True, nogil=True)
def _incidence(quads, index, pinhole, out):  # pragma: no cover - compiled
    """Fill `out` with the cosine of incidence of every pixel's ray."""
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            if index[v, u] >= 0:
                x = (u - pinhole[2]) / pinhole[0]
                y = (v - pinhole[3]) / pinhole[1]
                out[v, u] = _cosine(quads[index[v, u]], x, y)


@numba.njit(cache=True, nogil=True)
def _texture(quads, visible, pinhole, textures, out):  # pragma: no cover - compiled
    """Add up the texture samples of the fine pixels under every pixel of `out`."""
    depth, index = visible
    texels, offsets, shapes = textures
    share = 1.0 / _SUPERSAMPLING**2
    for v in range(depth.shape[0]):
        y = (v - pinhole[3]) / pinhole[1]
        for u in range(depth.shape[1]):
            q = index[v, u]
            if q < 0:
                continue
            g, z, x = quads[q], depth[v, u], (u - pinhole[2]) / pinhole[0]
            px, py, pz = z * x - g[0], z * y - g[1], z - g[2]
            across = (px * g[3] + py * g[4] + pz * g[5]) / g[12]
            down = (px * g[6] + py * g[7] + pz * g[8]) / g[13]
            # The level whose texel is about as wide as the pixel's footprint on the surface.
            footprint = z / pinhole[0] / max(_cosine(g, x, y), 0.25) / TEXEL_M
            level = min(max(int(np.floor(np.log2(footprint) + 0.5)), 0), MIP_LEVELS - 1)
            rows, columns = shapes[q, level]
            pixel = out[v // _SUPERSAMPLING, u // _SUPERSAMPLING]
            at = (down * rows - 0.5, across * columns - 0.5)
            _add_sample(texels[offsets[q, level] :], (rows, columns), at, share, pixel)


@numba.njit(cache=True, nogil=True)
def _add_sample(texels, shape, at, share, pixel):  # pragma: no cover - compiled
    """Add a bilinear sample at (row, column) times `share` to `pixel` [3]."""
    rows, columns = shape
    row = min(max(at[0], 0.0), rows - 1.001)
    column = min(max(at[1], 0.0), columns - 1.001)
    r0, c0 = int(max(row, 0.0)), int(max(column, 0.0))
    r1, c1 = min(r0 + 1, rows - 1), min(c0 + 1, columns - 1)
    fr, fc = max(row, 0.0) - r0, max(column, 0.0) - c0
    for k in range(3):
        top = (1 - fc) * texels[3 * (r0 * columns + c0) + k]
        top += fc * texels[3 * (r0 * columns + c1) + k]
        low = (1 - fc) * texels[3 * (r1 * columns + c0) + k]
        low += fc * texels[3 * (r1 * columns + c1) + k]
        pixel[k] += share * ((1 - fr) * top + fr * low)
