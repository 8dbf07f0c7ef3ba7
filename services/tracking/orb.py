"""ORB features spread over the image, with depth where it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import OrbConfig
from shared.camera import Intrinsics
from shared.rectify import RgbdImage


@dataclass(frozen=True)
class Keypoints:
    """ORB features of a colour image, best first."""

    keypoints_px: NDArray[np.float32]  # [M, 2]
    octaves: NDArray[np.uint8]  # [M]
    descriptors: NDArray[np.uint8]  # [M, 32]


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


def detect(
    rgb: NDArray[np.uint8], config: OrbConfig, where: NDArray[np.bool_] | None = None
) -> Keypoints:
    """Detect where the mask [H, W] allows it, spread over cells, describe.

    OpenCV keeps the strongest corners wherever they crowd; the pose wants them all over the image,
    so more are detected and each cell gives its best ones in turn. ORB-SLAM, too, looks again at a
    lower threshold where hardly anything is found.
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    mask = None if where is None else where.astype(np.uint8)
    keypoints, descriptors = _orb(config.fast_threshold, config).detectAndCompute(grey, mask)
    if len(keypoints) < config.few_features:
        keypoints, descriptors = _orb(config.faint_threshold, config).detectAndCompute(grey, mask)
    if not keypoints:
        return _no_keypoints()
    pixels = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32)
    octaves = np.array([k.octave for k in keypoints], np.uint8)
    responses = np.array([k.response for k in keypoints], np.float32)
    chosen = spread(pixels, responses, config.cell_px, config.num_features)
    assert descriptors is not None
    return Keypoints(
        pixels[chosen], octaves[chosen], np.ascontiguousarray(descriptors[chosen], np.uint8)
    )


def _orb(fast_threshold: int, config: OrbConfig) -> cv2.ORB:
    return cv2.ORB.create(
        nfeatures=config.num_detected, nlevels=config.num_levels, fastThreshold=fast_threshold
    )


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
    none = _no_keypoints()
    return Features(
        none.keypoints_px,
        none.octaves,
        none.descriptors,
        np.zeros(0, np.float32),
        np.zeros(0, np.bool_),
    )


def _no_keypoints() -> Keypoints:
    return Keypoints(
        np.zeros((0, 2), np.float32), np.zeros(0, np.uint8), np.zeros((0, 32), np.uint8)
    )


def spread(
    pixels: NDArray[np.float32], responses: NDArray[np.float32], cell_px: int, limit: int
) -> NDArray[np.int64]:
    """Indices of up to `limit` keypoints: the best of every cell, then the second best, ..."""
    order = np.argsort(-responses, kind="stable")
    ranks = _ranks_in_cells(pixels[order], cell_px)
    return order[np.argsort(ranks, kind="stable")[:limit]]


@numba.njit(cache=True, nogil=True)
def _ranks_in_cells(pixels, cell_px):  # pragma: no cover - compiled
    """How many keypoints before this one lie in the same cell, [M]."""
    columns = int(pixels[:, 0].max() // cell_px) + 1
    rows = int(pixels[:, 1].max() // cell_px) + 1
    counts = np.zeros((rows, columns), np.int32)
    ranks = np.empty(len(pixels), np.int32)
    for n in range(len(pixels)):
        row, column = int(pixels[n, 1] // cell_px), int(pixels[n, 0] // cell_px)
        ranks[n] = counts[row, column]
        counts[row, column] += 1
    return ranks


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
