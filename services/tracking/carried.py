"""Features that go with the camera: at the pixel and the depth where a keyframe saw them."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import MovingConfig
from services.tracking.matching import grid_of, popcount, words_of
from services.tracking.observed import Observed
from services.tracking.point_cloud import BASE_PIXELS
from shared.camera import Intrinsics
from shared.se3 import inverse
from shared.tracks import MOVING, WindowKeyframe


@dataclass(frozen=True)
class StandingStill:
    """Features as one of the window's keyframes saw them; the camera may have moved or not."""

    keypoints_px: NDArray[np.float32]  # [S, 2]
    points_camera: NDArray[np.float64]  # [S, 3]
    T_world_keyframes: NDArray[np.float64]  # [S, 4, 4], of the keyframe that saw each

    def moves_px(
        self, T_world_camera: NDArray[np.float64], intrinsics: Intrinsics
    ) -> NDArray[np.float64]:
        """How far each would have moved in the image, were it part of the map, [S]."""
        T = inverse(T_world_camera) @ self.T_world_keyframes
        points = np.einsum("sij,sj->si", T[:, :3, :3], self.points_camera) + T[:, :3, 3]
        i, z = intrinsics, np.maximum(points[:, 2:], 1e-3)
        pixels = points[:, :2] / z * [i.fx, i.fy] + [i.cx, i.cy]
        return np.linalg.norm(pixels - self.keypoints_px, axis=1)


@dataclass(frozen=True)
class SeenFeatures:
    """Features with depth of some keyframes in one list."""

    keypoints_px: NDArray[np.float32]  # [O, 2]
    depths_m: NDArray[np.float32]  # [O]
    words: NDArray[np.uint64]  # [O, 4], descriptors
    keyframes: NDArray[np.int64]  # [O], rows of the poses
    T_world_keyframes: NDArray[np.float64]  # [K, 4, 4]

    @staticmethod
    def of(window: tuple[WindowKeyframe, ...], only_moving: bool) -> SeenFeatures:
        """All that the keyframes saw, or only what is known to move."""
        seen = [keyframe.observations for keyframe in window]
        ids = np.concatenate([np.zeros(0, np.int64), *(s.landmark_ids for s in seen)])
        depths_m = np.concatenate([np.zeros(0, np.float32), *(s.depths_m for s in seen)])
        keep = (depths_m > 0.0) & ((ids == MOVING) | (not only_moving))
        pixels = np.concatenate([np.zeros((0, 2), np.float32), *(s.keypoints_px for s in seen)])
        bits = np.concatenate([np.zeros((0, 32), np.uint8), *(s.descriptors for s in seen)])
        keyframes = np.repeat(np.arange(len(seen)), [len(s.depths_m) for s in seen])
        poses = [keyframe.T_world_camera for keyframe in window] or [np.eye(4)]
        return SeenFeatures(
            keypoints_px=pixels[keep],
            depths_m=depths_m[keep],
            words=words_of(bits[keep]),
            keyframes=keyframes[keep],
            T_world_keyframes=np.stack(poses),
        )


def standing_still(observed: Observed, seen: SeenFeatures, config: MovingConfig) -> StandingStill:
    """Features of a frame that are where a keyframe saw them."""
    features, i = observed.features, observed.intrinsics
    rows = np.full(len(features.octaves), -1, np.int64)
    if len(rows):
        _find_still(
            (features.keypoints_px, features.depths_m, words_of(features.descriptors)),
            grid_of(features.keypoints_px, i.width, i.height),
            (seen.keypoints_px, seen.depths_m, seen.words),
            np.array([still_px(i, config), config.still_depth, config.still_bits]),
            rows,
        )
    found = np.flatnonzero(rows >= 0)
    return StandingStill(
        keypoints_px=features.keypoints_px[found],
        points_camera=features.points_camera(i)[found],
        T_world_keyframes=seen.T_world_keyframes[seen.keyframes[rows[found]]],
    )


def still_px(intrinsics: Intrinsics, config: MovingConfig) -> float:
    """How far a feature that stands still is found from where it was."""
    return config.still_px * float(np.sqrt(intrinsics.width * intrinsics.height / BASE_PIXELS))


@numba.njit(cache=True, nogil=True)
def _find_still(here, grid, there, limits, found):  # pragma: no cover - compiled
    """For each feature of an image [M] the first of the others with its place and looks."""
    starts, order, columns = grid
    rows, reach = (len(starts) - 1) // columns, limits[0]
    for n in range(len(there[0])):
        u, v = there[0][n]
        first = max(int((u - reach) // 16), 0)
        last = min(int((u + reach) // 16), columns - 1)
        for r in range(max(int((v - reach) // 16), 0), min(int((v + reach) // 16) + 1, rows)):
            # Cells of a row follow each other, so do their features.
            for s in range(starts[r * columns + first], starts[r * columns + last + 1]):
                f = order[s]
                if found[f] < 0 and _is_same(here, f, there, n, limits):
                    found[f] = n


@numba.njit(cache=True, nogil=True, inline="always")
def _is_same(here, f, there, n, limits):  # pragma: no cover - compiled
    """Whether two features agree in pixel, depth and descriptor."""
    du, dv = here[0][f, 0] - there[0][n, 0], here[0][f, 1] - there[0][n, 1]
    if du * du + dv * dv > limits[0] * limits[0]:
        return False
    if abs(here[1][f] - there[1][n]) > limits[1] * there[1][n]:
        return False
    bits = 0
    for k in range(4):
        bits += popcount(here[2][f, k] ^ there[2][n, k])
    return bits <= limits[2]
