"""ORB features with depth where it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import OrbConfig
from services.tracking.detection import Keypoints, detect, no_keypoints
from shared.camera import Intrinsics
from shared.rectify import RgbdImage


@dataclass(frozen=True)
class Features:
    """ORB features of one image, best first."""

    keypoints_px: NDArray[np.float32]  # [M, 2]
    octaves: NDArray[np.uint8]  # [M]
    descriptors: NDArray[np.uint8]  # [M, 32]
    depths_m: NDArray[np.float32]  # [M], 0 where none is reliable
    is_unmeasured: NDArray[np.bool_]  # [M], no depth around it: not noisy, nor at an edge

    def points_camera(self, intrinsics: Intrinsics) -> NDArray[np.float64]:
        """Keypoints lifted by their depth, [M, 3]; zero where there is none."""
        return backproject(self.keypoints_px, self.depths_m, intrinsics)

    def first(self, count: int) -> Features:
        """The best ones."""
        return self.rows(np.arange(min(count, len(self.octaves))))

    def rows(self, rows: NDArray[np.int64]) -> Features:
        """Some of them."""
        return Features(
            self.keypoints_px[rows],
            self.octaves[rows],
            self.descriptors[rows],
            self.depths_m[rows],
            self.is_unmeasured[rows],
        )

    def joined(self, others: Features) -> Features:
        """These, then the others."""
        return Features(
            np.concatenate([self.keypoints_px, others.keypoints_px]),
            np.concatenate([self.octaves, others.octaves]),
            np.concatenate([self.descriptors, others.descriptors]),
            np.concatenate([self.depths_m, others.depths_m]),
            np.concatenate([self.is_unmeasured, others.is_unmeasured]),
        )


def backproject(
    keypoints_px: NDArray[np.float32], depths_m: NDArray[np.float32], intrinsics: Intrinsics
) -> NDArray[np.float64]:
    """Pixels [M, 2] with depth along the optical axis [M] as points of the camera frame, [M, 3]."""
    z = depths_m.astype(np.float64)
    x = (keypoints_px[:, 0] - intrinsics.cx) / intrinsics.fx * z
    y = (keypoints_px[:, 1] - intrinsics.cy) / intrinsics.fy * z
    return np.stack([x, y, z], axis=1)


def extract_features(image: RgbdImage, config: OrbConfig) -> Features:
    """Features of an image, with depth where it can be trusted."""
    return with_depth(detect(image.rgb, config), image.depth_m, config)


def with_depth(keypoints: Keypoints, depth_m: NDArray[np.float32], config: OrbConfig) -> Features:
    """Look up each keypoint in the registered depth image.

    Where even the calmest patches are noisy, readings need not agree better than these do.
    """
    depths, spreads = _patches(depth_m, keypoints.keypoints_px, config.max_feature_depth_m)
    is_trusted = spreads <= _max_spread(spreads, config)
    is_unmeasured = ~is_trusted & (depths == 0.0)
    depths = np.where(is_trusted, depths, np.float32(0.0))
    k = keypoints
    return Features(k.keypoints_px, k.octaves, k.descriptors, depths, is_unmeasured)


def _max_spread(spreads: NDArray[np.float64], config: OrbConfig) -> float:
    """How far the readings of a patch may lie apart in an image of this noise, relative."""
    measured = spreads[np.isfinite(spreads)]
    if len(measured) == 0:
        return config.max_depth_spread
    usual = config.noise_spreads * float(np.quantile(measured, 0.25))
    return min(max(usual, config.max_depth_spread), config.max_noisy_depth_spread)


def no_features() -> Features:
    """An image without any."""
    none = no_keypoints()
    return Features(
        none.keypoints_px,
        none.octaves,
        none.descriptors,
        np.zeros(0, np.float32),
        np.zeros(0, np.bool_),
    )


@numba.njit(cache=True, nogil=True)
def _patches(depth, pixels, max_depth):  # pragma: no cover - compiled
    """Mean depth of each keypoint's 3x3 patch, and how far its readings lie apart, relative.

    Infinitely far where there are too few; no depth where one of them is too far away.
    """
    height, width = depth.shape
    depths, spreads = np.zeros(len(pixels), np.float32), np.full(len(pixels), np.inf)
    for n in range(len(pixels)):
        u = int(np.floor(pixels[n, 0] + 0.5))
        v = int(np.floor(pixels[n, 1] + 0.5))
        low, high, total, count = np.inf, 0.0, 0.0, 0
        for vv in range(max(v - 1, 0), min(v + 2, height)):
            for uu in range(max(u - 1, 0), min(u + 2, width)):
                z = depth[vv, uu]
                if z > 0.0:
                    low, high, total, count = min(low, z), max(high, z), total + z, count + 1
        if count > 0 and high <= max_depth:
            depths[n] = total / count
        if count >= 6 and high <= max_depth:
            spreads[n] = (high - low) / low
    return depths, spreads
