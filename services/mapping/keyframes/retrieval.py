"""Place recognition: which keyframes look like a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.mapping.keyframes.stored import StoredKeyframe
from shared.errors import ConfigError
from shared.se3 import angle_rad, inverse


@dataclass(frozen=True)
class RetrievalConfig:
    """How candidates are found."""

    max_compared: int = 30  # keyframes whose descriptors are compared, best thumbnails first
    max_descriptors: int = 300  # of the frame and of each keyframe
    max_hamming_bits: int = 50

    def __post_init__(self) -> None:
        if not 0 <= self.max_hamming_bits <= 256:
            raise ConfigError(f"max_hamming_bits must be 0 to 256, got {self.max_hamming_bits}")


def rank_keyframes(
    thumbnail: NDArray[np.uint8],
    descriptors: NDArray[np.uint8],
    keyframes: list[StoredKeyframe],
    config: RetrievalConfig,
) -> list[StoredKeyframe]:
    """Keyframes in order of likeness.

    Thumbnails choose whom to compare; the number of descriptors with a near one in the keyframe
    orders those. Descriptors do not change with exposure, thumbnails cost nothing.

    Args:
        thumbnail: grey, [15, 20].
        descriptors: ORB, [M, 32].
        keyframes: all of the map.
        config: limits.
    """
    likeness = thumbnail_correlation(thumbnail, np.stack([k.thumbnail for k in keyframes]))
    order = np.argsort(-likeness, kind="stable")[: config.max_compared]
    limits = config.max_descriptors, config.max_hamming_bits
    votes = np.array(
        [count_alike(descriptors, keyframes[i].observations.descriptors, *limits) for i in order]
    )
    return [keyframes[i] for i in order[np.argsort(-votes, kind="stable")]]


def count_alike(
    descriptors: NDArray[np.uint8],
    others: NDArray[np.uint8],
    max_descriptors: int,
    max_hamming_bits: int,
) -> int:
    """How many ORB descriptors [M, 32] have a near one among others [N, 32]."""
    query, stored = _packed(descriptors, max_descriptors), _packed(others, max_descriptors)
    return int(_count_near(query, stored, max_hamming_bits))


def nearest_view(
    T_world_camera: NDArray[np.float64], keyframes: list[StoredKeyframe]
) -> StoredKeyframe:
    """The keyframe whose view differs least: a radian counts as much as the depth it looks at."""

    def difference(keyframe: StoredKeyframe) -> float:
        step = inverse(keyframe.T_world_camera) @ T_world_camera
        return float(np.linalg.norm(step[:3, 3])) + keyframe.cone.far_m * angle_rad(step)

    return min(keyframes, key=difference)


def thumbnail_correlation(
    thumbnail: NDArray[np.uint8], others: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """Normalised cross correlation of [15, 20] with each of [K, 15, 20], [K]."""
    return _normalised(others) @ _normalised(thumbnail[None])[0]


def _normalised(thumbnails: NDArray[np.uint8]) -> NDArray[np.float64]:
    flat = thumbnails.reshape(len(thumbnails), -1).astype(np.float64)
    flat = flat - flat.mean(axis=1, keepdims=True)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)


def _packed(descriptors: NDArray[np.uint8], limit: int) -> NDArray[np.uint64]:
    """Evenly chosen descriptors as four words each, [M, 4]."""
    step = max(1, -(-len(descriptors) // limit))
    return np.ascontiguousarray(descriptors[::step]).view(np.uint64).reshape(-1, 4)


@numba.njit(cache=True, nogil=True)
def _count_near(query, stored, max_bits):  # pragma: no cover - compiled
    count = 0
    for i in range(len(query)):
        for j in range(len(stored)):
            bits = 0
            for word in range(4):
                bits += _popcount(query[i, word] ^ stored[j, word])
            if bits <= max_bits:
                count += 1
                break
    return count


@numba.njit(cache=True, nogil=True)
def _popcount(x):  # pragma: no cover - compiled
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
