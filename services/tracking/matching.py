"""Features to landmarks: by projection where a pose is known, by descriptor alone where not."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import OrbConfig
from services.tracking.orb import Features
from shared.camera import Intrinsics
from shared.se3 import inverse
from shared.tracks import Landmarks


@dataclass(frozen=True)
class Matches:
    """Pairs of a feature and a landmark; each feature and each landmark at most once."""

    features: NDArray[np.int64]  # [P], rows of the features
    landmarks: NDArray[np.int64]  # [P], rows of the landmarks

    def __len__(self) -> int:
        return len(self.features)

    def where(self, keep: NDArray[np.bool_]) -> Matches:
        """Some of the pairs."""
        return Matches(self.features[keep], self.landmarks[keep])


def match_by_projection(
    features: Features,
    landmarks: Landmarks,
    T_world_camera: NDArray[np.float64],
    intrinsics: Intrinsics,
    config: OrbConfig,
) -> Matches:
    """Look for each landmark around the pixel where the pose puts it, at about its scale."""
    if len(features.octaves) == 0 or len(landmarks.ids) == 0:
        return _no_matches()
    i = intrinsics
    best, distances = _search(
        (
            landmarks.positions_world,
            landmarks.normals_world,
            words_of(landmarks.descriptors),
            landmarks.octaves,
            landmarks.distances_m,
        ),
        (features.keypoints_px, features.octaves, words_of(features.descriptors)),
        grid_of(features.keypoints_px, i.width, i.height),
        (inverse(T_world_camera), np.array([i.fx, i.fy, i.cx, i.cy])),
        np.array([config.search_radius_px, config.max_hamming_bits, config.ratio]),
    )
    return _one_to_one(best, distances, len(features.octaves))


def match_by_descriptor(features: Features, landmarks: Landmarks, config: OrbConfig) -> Matches:
    """Nearest descriptors, distinct from the second nearest; each landmark to its nearest one."""
    if len(features.octaves) < 2 or len(landmarks.ids) < 2:
        return _no_matches()
    nearest, bits, second_bits = two_nearest(features.descriptors, landmarks.descriptors)
    is_distinct = bits < config.ratio_global * second_bits
    rows = np.flatnonzero((bits <= config.max_hamming_bits_global) & is_distinct)
    best = np.full(len(landmarks.ids), -1, np.int64)
    distances = np.full(len(landmarks.ids), 257, np.int64)
    for feature in rows:
        landmark = nearest[feature]
        if bits[feature] < distances[landmark]:
            best[landmark], distances[landmark] = feature, bits[feature]
    return _one_to_one(best, distances, len(features.octaves))


def two_nearest(
    descriptors: NDArray[np.uint8], others: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Of each descriptor [M, 32] among others [L, 32]: the nearest row, its bits, the second's."""
    return _two_nearest(words_of(descriptors), np.ascontiguousarray(words_of(others).T))


def _no_matches() -> Matches:
    return Matches(np.zeros(0, np.int64), np.zeros(0, np.int64))


def words_of(descriptors: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """ORB descriptors [M, 32] as 64 bit words, [M, 4]."""
    return np.ascontiguousarray(descriptors).view(np.uint64).reshape(-1, 4)


_CELL_PX = 16


def _one_to_one(
    best: NDArray[np.int64], distances: NDArray[np.int64], num_features: int
) -> Matches:
    """Of the landmarks that want the same feature, the nearest descriptor gets it."""
    landmarks = np.flatnonzero(_wins(best, distances, num_features))
    return Matches(best[landmarks], landmarks)


@numba.njit(cache=True, nogil=True)
def _wins(best, distances, num_features):  # pragma: no cover - compiled
    """Which landmarks get the feature they want; the first of equally near ones does."""
    winners = np.full(num_features, -1, np.int64)
    wins = np.zeros(len(best), np.bool_)
    for n in range(len(best)):
        feature = best[n]
        if feature < 0:
            continue
        rival = winners[feature]
        if rival < 0 or distances[n] < distances[rival]:
            if rival >= 0:
                wins[rival] = False
            wins[n] = True
            winners[feature] = n
    return wins


@numba.njit(cache=True, nogil=True)
def grid_of(pixels, width, height):  # pragma: no cover - compiled
    """Features by cell: starts [cells + 1], rows in cell order, cells a row of the image."""
    columns, rows = width // _CELL_PX + 1, height // _CELL_PX + 1
    cells = np.empty(len(pixels), np.int64)
    starts = np.zeros(rows * columns + 1, np.int64)
    for n in range(len(pixels)):
        column = min(max(int(pixels[n, 0] // _CELL_PX), 0), columns - 1)
        row = min(max(int(pixels[n, 1] // _CELL_PX), 0), rows - 1)
        cells[n] = row * columns + column
        starts[cells[n] + 1] += 1
    for cell in range(rows * columns):
        starts[cell + 1] += starts[cell]
    filled = starts.copy()
    order = np.empty(len(pixels), np.int64)
    for n in range(len(pixels)):
        order[filled[cells[n]]] = n
        filled[cells[n]] += 1
    return starts, order, columns


@numba.njit(cache=True, nogil=True)
def _search(landmarks, features, grid, view, limits):  # noqa: C901  # pragma: no cover - compiled
    """The nearest feature of each landmark [L], -1 where none will do, and its bits.

    Landmarks are (positions, normals, words, octaves, distances), features (pixels, octaves,
    words), `grid` theirs, `view` (T_camera_world, camera), limits (radius, bits, ratio).
    """
    positions, normals, words, octaves, distances = landmarks
    pixels, feature_octaves, feature_words = features
    R, camera = view
    starts, order, columns = grid
    rows = (len(starts) - 1) // columns
    count = len(positions)
    best = np.full(count, -1, np.int64)
    bits = np.full(count, 257, np.int64)
    margin = limits[0] * 1.2**4  # the largest radius of a search
    for n in range(count):
        X = positions[n]
        x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + R[0, 3]
        y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + R[1, 3]
        z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + R[2, 3]
        if z < 0.05:
            continue
        u = camera[0] * x / z + camera[2]
        v = camera[1] * y / z + camera[3]
        if not (-margin < u < 16 * columns + margin and -margin < v < 16 * rows + margin):
            continue
        length = np.sqrt(x * x + y * y + z * z)
        # Seen from behind, or at a scale that the pyramid does not reach: not the same patch.
        w = normals[n]
        nx = R[0, 0] * w[0] + R[0, 1] * w[1] + R[0, 2] * w[2]
        ny = R[1, 0] * w[0] + R[1, 1] * w[1] + R[1, 2] * w[2]
        nz = R[2, 0] * w[0] + R[2, 1] * w[1] + R[2, 2] * w[2]
        if nx * x + ny * y + nz * z > 0.1 * length:
            continue
        level = octaves[n] + np.log(max(distances[n], 0.05) / length) / np.log(1.2)
        radius = limits[0] * 1.2 ** min(max(level, 0.0), 4.0)
        c0 = max(int((u - radius) // 16), 0)
        c1 = min(int((u + radius) // 16), columns - 1)
        r0 = max(int((v - radius) // 16), 0)
        r1 = min(int((v + radius) // 16), rows - 1)
        nearest, second, row_best, octave_best, octave_second = 257, 257, -1, -1, -2
        for r in range(r0, r1 + 1):
            for c in range(c0, c1 + 1):
                for s in range(starts[r * columns + c], starts[r * columns + c + 1]):
                    f = order[s]
                    if (pixels[f, 0] - u) ** 2 + (pixels[f, 1] - v) ** 2 > radius * radius:
                        continue
                    if abs(feature_octaves[f] - level) > 1.6:
                        continue
                    d = 0
                    for k in range(4):
                        d += popcount(words[n, k] ^ feature_words[f, k])
                    if d < nearest:
                        second, octave_second = nearest, octave_best
                        nearest, row_best, octave_best = d, f, feature_octaves[f]
                    elif d < second:
                        second, octave_second = d, feature_octaves[f]
        if nearest > limits[1]:
            continue
        if octave_best == octave_second and nearest > limits[2] * second:
            continue
        best[n] = row_best
        bits[n] = nearest
    return best, bits


@numba.njit(cache=True, nogil=True)
def _two_nearest(words, others):  # pragma: no cover - compiled
    """Of each descriptor [M, 4]: the nearest of the others [4, L], its bits and the second's."""
    nearest = np.empty(len(words), np.int64)
    bits = np.empty(len(words), np.int64)
    second_bits = np.empty(len(words), np.int64)
    distances = np.empty(others.shape[1], np.int32)
    for m in range(len(words)):
        a, b, c, d = words[m]
        for n in range(others.shape[1]):  # vectors: no branch before all distances are there
            distances[n] = (
                popcount(others[0, n] ^ a)
                + popcount(others[1, n] ^ b)
                + popcount(others[2, n] ^ c)
                + popcount(others[3, n] ^ d)
            )
        first, best = _least(distances), 0
        while distances[best] != first:
            best += 1
        distances[best] = 257
        nearest[m], bits[m], second_bits[m] = best, first, _least(distances)
    return nearest, bits, second_bits


@numba.njit(cache=True, nogil=True, inline="always")
def _least(values):  # pragma: no cover - compiled
    """The smallest of some numbers of bits; a vector at a time."""
    least = np.int32(257)
    for n in range(len(values)):
        least = min(least, values[n])
    return least


@numba.njit(cache=True, nogil=True, inline="always")
def popcount(x):  # pragma: no cover - compiled
    """Number of ones in a 64 bit word."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
