"""Light baked into textures: a ceiling lamp and a window with soft shadows, and a lit ambience.

Ambience is the share of the hemisphere within a metre that is free, so that corners darken.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from pointslam.synth.scene import pack_scene
from pointslam.synth.surfaces import Surface, Vector

_STEP_M = 0.07
_LIGHT_SAMPLES = 12
_AMBIENT_SAMPLES = 20
_AMBIENT_REACH_M = 1.0
_LAMP_POWER, _WINDOW_POWER, _AMBIENT_POWER = 6.3, 4.5, 0.6


def bake_light(surfaces: Sequence[Surface], seed: int, threads: int) -> list[Surface]:
    """The same surfaces with their light in their textures; lamps stay as they are."""
    geometry = pack_scene(surfaces).geometry
    lamps = [i for i, s in enumerate(surfaces) if s.is_lamp]
    rng = np.random.default_rng([seed, 2])
    samples = np.concatenate([_points_on(surfaces[i], rng) for i in lamps])
    powers = np.repeat([_LAMP_POWER, _WINDOW_POWER][: len(lamps)], _LIGHT_SAMPLES)
    normals = np.repeat([surfaces[i].normal for i in lamps], _LIGHT_SAMPLES, axis=0)
    lights = np.c_[samples, normals, powers / _LIGHT_SAMPLES]
    hemisphere = _hemisphere(rng)
    occluders = np.delete(geometry, lamps, axis=0)

    def bake(surface: Surface) -> Surface:
        if surface.is_lamp:
            return surface
        points = _grid(surface)
        light = np.empty(points.shape[:2], np.float32)
        _illuminate(points, surface.normal, (occluders, lights, hemisphere), light)
        return dataclasses.replace(surface, texture=_shade(surface.texture, light))

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(bake, surfaces))


def _points_on(surface: Surface, rng: np.random.Generator) -> NDArray[np.float64]:
    share = rng.uniform(0.05, 0.95, (_LIGHT_SAMPLES, 2))
    across = share[:, :1] * surface.width_m * surface.right
    return surface.origin + across + share[:, 1:] * surface.height_m * surface.down


def _hemisphere(rng: np.random.Generator) -> NDArray[np.float64]:
    """Directions, cosine weighted, about +z, [N, 3]."""
    radius = np.sqrt((np.arange(_AMBIENT_SAMPLES) + 0.5) / _AMBIENT_SAMPLES)
    turn = np.arange(_AMBIENT_SAMPLES) * 2.399963 + rng.uniform(0, 2 * np.pi)  # the golden angle
    return np.c_[radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - radius**2)]


def _grid(surface: Surface) -> NDArray[np.float64]:
    columns = max(int(np.ceil(surface.width_m / _STEP_M)), 2)
    rows = max(int(np.ceil(surface.height_m / _STEP_M)), 2)
    across = (np.arange(columns) + 0.5) / columns * surface.width_m
    along = (np.arange(rows) + 0.5) / rows * surface.height_m
    lifted: Vector = surface.origin + 2e-3 * surface.normal
    return lifted + along[:, None, None] * surface.down + across[None, :, None] * surface.right


def _shade(texture: NDArray[np.uint8], light: NDArray[np.float32]) -> NDArray[np.uint8]:
    rows, columns = texture.shape[:2]
    smooth = cv2.resize(light, (columns, rows), interpolation=cv2.INTER_LINEAR)
    gain = np.power(np.maximum(smooth, 0.02), 1 / 2.2, dtype=np.float32)
    return np.clip(texture * gain[..., None], 0, 255).astype(np.uint8)


@numba.njit(cache=True, nogil=True)
def _is_blocked(point, ray, reach, occluders):  # pragma: no cover - compiled
    """Whether a rectangle crosses `point + t * ray` for t in (0, reach)."""
    for q in range(len(occluders)):
        o = occluders[q]
        along = ray[0] * o[9] + ray[1] * o[10] + ray[2] * o[11]
        if along > -1e-9:  # seen from behind: the box's other side stops the ray
            continue
        tx, ty, tz = o[0] - point[0], o[1] - point[1], o[2] - point[2]
        t = (tx * o[9] + ty * o[10] + tz * o[11]) / along
        if t <= 0.0 or t >= reach:
            continue
        hx, hy, hz = t * ray[0] - tx, t * ray[1] - ty, t * ray[2] - tz
        across = hx * o[3] + hy * o[4] + hz * o[5]
        down = hx * o[6] + hy * o[7] + hz * o[8]
        if 0.0 <= across <= o[12] and 0.0 <= down <= o[13]:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _direct(point, normal, occluders, lights):  # pragma: no cover - compiled
    """Light that lamps send straight to a point."""
    total = 0.0
    for i in range(len(lights)):
        ray = lights[i, :3] - point
        squared = ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2
        received, sent = 0.0, 0.0
        for k in range(3):
            received += ray[k] * normal[k]
            sent -= ray[k] * lights[i, 3 + k]
        if received <= 0.0 or sent <= 0.0:
            continue
        if not _is_blocked(point, ray, 0.999, occluders):
            total += lights[i, 6] * received * sent / (squared * max(squared, 0.25))
    return total


@numba.njit(cache=True, nogil=True)
def _illuminate(points, normal, surroundings, out):  # pragma: no cover - compiled
    """Fill `out` [R, C] with relative light at `points` [R, C, 3]."""
    occluders, lights, hemisphere = surroundings
    side = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    tangent = np.cross(side, normal)
    tangent /= np.sqrt(np.sum(tangent**2))
    bitangent = np.cross(normal, tangent)
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            point = points[r, c]
            free = 0
            for i in range(len(hemisphere)):
                h = hemisphere[i]
                ray = h[0] * tangent + h[1] * bitangent + h[2] * normal
                if not _is_blocked(point, ray, _AMBIENT_REACH_M, occluders):
                    free += 1
            ambient = _AMBIENT_POWER * free / len(hemisphere)
            out[r, c] = ambient + _direct(point, normal, occluders, lights)
