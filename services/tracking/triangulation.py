"""Landmarks from two views: features without depth that a keyframe and an earlier one both see.

Each feature without depth waits under the id of a landmark that has no position yet. A keyframe
looks for those of the window along their epipolar lines; where the rays meet at an angle the
landmark is placed, and bundle adjustment refines it with every keyframe that sees it again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import TriangulationConfig
from services.tracking.matching import popcount, words_of
from shared.camera import Intrinsics
from shared.se3 import inverse, transform
from shared.tracks import KEYPOINT_BITS, Observations, WindowKeyframe

_NEAREST_M = 0.1


@dataclass(frozen=True)
class Triangulated:
    """Waiting landmarks that a keyframe's features have placed."""

    features: NDArray[np.int64]  # [P], rows of the keyframe's observations
    landmark_ids: NDArray[np.int64]  # [P]
    positions_world: NDArray[np.float64]  # [P, 3]

    def named(self, observations: Observations) -> Observations:
        """The keyframe's observations, with the landmarks that these features placed."""
        ids = observations.landmark_ids.copy()
        ids[self.features] = self.landmark_ids
        return replace(observations, landmark_ids=ids)


def triangulate(
    keyframe: WindowKeyframe,
    window: tuple[WindowKeyframe, ...],
    intrinsics: Intrinsics,
    config: TriangulationConfig,
) -> Triangulated:
    """Place what waits in the window's keyframes and is seen in a new one, nearest views first.

    Args:
        keyframe: the new one, adjusted.
        window: earlier keyframes, adjusted.
        intrinsics: the camera of all keypoints.
        config: limits of a match.
    """
    rows = np.flatnonzero(is_waiting(keyframe))
    parts = [_nothing()]
    for earlier in sorted(window, key=lambda other: -other.seq):
        placed = _from_pair(keyframe, rows, earlier, intrinsics, config)
        rows = np.setdiff1d(rows, placed.features, assume_unique=True)
        parts.append(placed)
    return Triangulated(
        np.concatenate([part.features for part in parts]),
        np.concatenate([part.landmark_ids for part in parts]),
        np.concatenate([part.positions_world for part in parts]),
    )


def is_waiting(keyframe: WindowKeyframe) -> NDArray[np.bool_]:
    """Which features have the id of a landmark of their own, and no depth to place it, [M]."""
    seen = keyframe.observations
    return (seen.landmark_ids >> KEYPOINT_BITS == keyframe.seq) & (seen.depths_m <= 0.0)


def _nothing() -> Triangulated:
    none = np.zeros(0, np.int64)
    return Triangulated(none, none, np.zeros((0, 3)))


def _from_pair(
    keyframe: WindowKeyframe,
    rows: NDArray[np.int64],
    earlier: WindowKeyframe,
    intrinsics: Intrinsics,
    config: TriangulationConfig,
) -> Triangulated:
    """What an earlier keyframe has waiting and some rows of the new one place."""
    waiting = np.flatnonzero(is_waiting(earlier))
    if len(rows) == 0 or len(waiting) == 0:
        return _nothing()
    best, depths_m, bits = _search(
        _arrays(earlier.observations, waiting, intrinsics),
        _arrays(keyframe.observations, rows, intrinsics),
        inverse(keyframe.T_world_camera) @ earlier.T_world_camera,
        _limits(intrinsics, config),
    )
    kept = _one_to_one(best, bits)
    rays = _rays(earlier.observations.keypoints_px[waiting[kept]], intrinsics)
    return Triangulated(
        features=rows[best[kept]],
        landmark_ids=earlier.observations.landmark_ids[waiting[kept]],
        positions_world=transform(earlier.T_world_camera, depths_m[kept, None] * rays),
    )


def _limits(intrinsics: Intrinsics, config: TriangulationConfig) -> NDArray[np.float64]:
    focal_px = np.sqrt(intrinsics.fx * intrinsics.fy)
    parallax = np.sin(np.radians(config.min_parallax_deg))
    return np.array(
        [config.epipolar_px / focal_px, parallax, config.max_hamming_bits, config.ratio]
    )


def _arrays(
    seen: Observations, rows: NDArray[np.int64], intrinsics: Intrinsics
) -> tuple[NDArray, NDArray, NDArray]:
    """Rays, octaves and descriptors of some features, as the kernel takes them."""
    rays = _rays(seen.keypoints_px[rows], intrinsics)
    return rays, seen.octaves[rows].astype(np.int64), words_of(seen.descriptors[rows])


def _rays(keypoints_px: NDArray[np.float32], i: Intrinsics) -> NDArray[np.float64]:
    """Points at a depth of one metre, [M, 3]."""
    pixels = keypoints_px.astype(np.float64)
    ones = np.ones(len(pixels))
    return np.column_stack([(pixels[:, 0] - i.cx) / i.fx, (pixels[:, 1] - i.cy) / i.fy, ones])


def _one_to_one(best: NDArray[np.int64], bits: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows that found something, the most alike where several found the same."""
    found = np.flatnonzero(best >= 0)
    found = found[np.argsort(bits[found], kind="stable")]
    _, first = np.unique(best[found], return_index=True)
    return np.sort(found[first])


@numba.njit(cache=True, nogil=True)
def _search(waiting, features, T, limits):  # noqa: C901  # pragma: no cover - compiled
    """Of each waiting feature [W] the row of the feature that it meets (-1: none), depth, bits.

    Both are (rays, octaves, words), T is T_keyframe_earlier, limits are (distance from the line at
    a depth of one metre, sine of the least parallax, bits, ratio to the second best).
    """
    rays, octaves, words = waiting
    other_rays, other_octaves, other_words = features
    best = np.full(len(rays), -1, np.int64)
    bits = np.full(len(rays), 257, np.int64)
    depths = np.zeros(len(rays))
    a, t, line = np.zeros(3), T[:3, 3].copy(), np.zeros(3)
    for n in range(len(rays)):
        for i in range(3):
            a[i] = T[i, 0] * rays[n, 0] + T[i, 1] * rays[n, 1] + T[i, 2] * rays[n, 2]
        _cross(t, a, line)
        reach = limits[0] * np.sqrt(line[0] ** 2 + line[1] ** 2)
        second = 257
        for f in range(len(other_rays)):
            b = other_rays[f]
            off = abs(line[0] * b[0] + line[1] * b[1] + line[2])
            if off > reach * 1.2 ** other_octaves[f]:
                continue
            d = 0
            for k in range(4):
                d += popcount(words[n, k] ^ other_words[f, k])
            if d >= second or d * limits[3] > limits[2]:
                continue
            z = _depth(a, b, t, limits[1])
            there = z * a[2] + t[2]
            if z < _NEAREST_M or there < _NEAREST_M:
                continue
            # The same patch is seen at a scale that follows its distance.
            level = octaves[n] + np.log(z / there) / np.log(1.2)
            if abs(other_octaves[f] - level) > 1.6:
                continue
            if d < bits[n]:
                second = bits[n]
                bits[n], best[n], depths[n] = d, f, z
            else:
                second = d
        if bits[n] > limits[2] or bits[n] > limits[3] * second:
            best[n] = -1
    return best, depths, bits


@numba.njit(cache=True, nogil=True, inline="always")
def _cross(a, b, out):  # pragma: no cover - compiled
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, nogil=True)
def _depth(a, b, t, parallax):  # pragma: no cover - compiled
    """How far along ray a, which starts at t, it is nearest to ray b; 0 where they hardly meet."""
    x, y = np.zeros(3), np.zeros(3)
    _cross(b, a, x)
    _cross(b, t, y)
    squared = x[0] ** 2 + x[1] ** 2 + x[2] ** 2
    lengths = (a[0] ** 2 + a[1] ** 2 + a[2] ** 2) * (b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    if squared < parallax**2 * lengths:
        return 0.0
    return -(x[0] * y[0] + x[1] * y[1] + x[2] * y[2]) / squared
