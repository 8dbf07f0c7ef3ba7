"""ORB keypoints spread over the image, found in two shares that two threads may take."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import OrbConfig
from services.tracking.executors import Once

_SCALE = 1.2  # of an octave's pixels to those of the one before


@dataclass(frozen=True)
class Keypoints:
    """ORB features of a colour image, best first."""

    keypoints_px: NDArray[np.float32]  # [M, 2]
    octaves: NDArray[np.uint8]  # [M]
    descriptors: NDArray[np.uint8]  # [M, 32]


@dataclass(frozen=True)
class Detected:
    """Keypoints of some octaves, wherever they crowd."""

    keypoints_px: NDArray[np.float32]  # [M, 2]
    octaves: NDArray[np.uint8]  # [M]
    descriptors: NDArray[np.uint8]  # [M, 32]
    responses: NDArray[np.float32]  # [M]


class Detection:
    """The search for one image's keypoints, where the mask [H, W] allows them.

    OpenCV keeps the strongest corners wherever they crowd; the pose wants them all over the image,
    so more are detected and each cell gives its best ones in turn. ORB-SLAM, too, looks again at a
    lower threshold where hardly anything is found.
    """

    def __init__(
        self, rgb: NDArray[np.uint8], config: OrbConfig, where: NDArray[np.bool_] | None = None
    ) -> None:
        self._grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        self._where = None if where is None else np.uint8(255) * where.astype(np.uint8)
        self._config = config
        self.finest = Once(lambda: self._of_finest(config.fast_threshold))

    def keypoints(self) -> Keypoints:
        """All that are kept; another thread may look for the finest octave's meanwhile."""
        config = self._config
        coarser = self._of_coarser(config.fast_threshold)
        found = _joined(self.finest.result(), coarser)
        if len(found.octaves) < config.few_features:
            threshold = config.faint_threshold
            found = _joined(self._of_finest(threshold), self._of_coarser(threshold))
        chosen = spread(found.keypoints_px, found.responses, config.cell_px, config.num_features)
        return Keypoints(
            found.keypoints_px[chosen], found.octaves[chosen], found.descriptors[chosen]
        )

    def _of_finest(self, threshold: int) -> Detected:
        orb = cv2.ORB.create(self._finest_count(), nlevels=1, fastThreshold=threshold)
        return _found(orb, self._grey, self._where)

    def _of_coarser(self, threshold: int) -> Detected:
        """On an image as large as the second octave, of which OpenCV makes the further ones."""
        config = self._config
        if config.num_levels == 1:
            return _nothing()
        count = config.num_detected - self._finest_count()
        orb = cv2.ORB.create(count, _SCALE, config.num_levels - 1, fastThreshold=threshold)
        found = _found(orb, _reduced(self._grey), _reduced_mask(self._where))
        height, width = self._grey.shape
        pixels = _in_image(found, (width, height))
        return Detected(pixels, found.octaves + np.uint8(1), found.descriptors, found.responses)

    def _finest_count(self) -> int:
        """As many to an octave as it has pixels along a line."""
        rest = _SCALE**-self._config.num_levels
        return round(self._config.num_detected * (1.0 - 1.0 / _SCALE) / (1.0 - rest))


def detect(
    rgb: NDArray[np.uint8], config: OrbConfig, where: NDArray[np.bool_] | None = None
) -> Keypoints:
    """Detect where the mask [H, W] allows it, spread over cells, describe."""
    return Detection(rgb, config, where).keypoints()


def no_keypoints() -> Keypoints:
    """An image without any."""
    none = _nothing()
    return Keypoints(none.keypoints_px, none.octaves, none.descriptors)


def _found(orb: cv2.ORB, grey: NDArray[np.uint8], where: NDArray[np.uint8] | None) -> Detected:
    keypoints, descriptors = orb.detectAndCompute(grey, where)
    if not keypoints:
        return _nothing()
    return Detected(
        np.asarray(cv2.KeyPoint.convert(keypoints), np.float32),
        np.array([k.octave for k in keypoints], np.uint8),
        np.asarray(descriptors, np.uint8),
        np.array([k.response for k in keypoints], np.float32),
    )


def _nothing() -> Detected:
    none = np.zeros((0, 2), np.float32)
    return Detected(none, np.zeros(0, np.uint8), np.zeros((0, 32), np.uint8), none[:, 0])


def _joined(finest: Detected, coarser: Detected) -> Detected:
    return Detected(
        np.concatenate([finest.keypoints_px, coarser.keypoints_px]),
        np.concatenate([finest.octaves, coarser.octaves]),
        np.concatenate([finest.descriptors, coarser.descriptors]),
        np.concatenate([finest.responses, coarser.responses]),
    )


def _size_of(size: tuple[int, int], octave: int) -> tuple[int, int]:
    """Width and height of an octave, as OpenCV rounds them."""
    width, height = np.rint(np.array(size) / _SCALE**octave).astype(int).tolist()
    return width, height


def _reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """As the second octave shows it."""
    size = _size_of((image.shape[1], image.shape[0]), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR_EXACT), np.uint8)


def _reduced_mask(where: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
    """Only what lies in the mask with all of its pixel."""
    return None if where is None else (_reduced(where) == 255).astype(np.uint8)


def _in_image(found: Detected, size: tuple[int, int]) -> NDArray[np.float32]:
    """Pixels [M, 2] of the full image for what was found in its second octave.

    OpenCV multiplies coordinates by the nominal scale, as if pixels had their centres at their
    corners and octaves were not rounded to whole pixels: keypoints of the coarsest octave then lie
    up to 1.3 pixels too far up and left.
    """
    reduced, octaves = _size_of(size, 1), int(found.octaves.max(initial=0)) + 1
    sizes = np.array([_size_of(reduced, octave) for octave in range(octaves)], np.float64)
    own = found.keypoints_px / (_SCALE ** found.octaves.astype(np.float64))[:, None]
    pixels = (own + 0.5) * (np.array(size) / sizes)[found.octaves] - 0.5
    return pixels.astype(np.float32)


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
    columns, rows = 1, 1
    for n in range(len(pixels)):
        columns = max(columns, int(pixels[n, 0] // cell_px) + 1)
        rows = max(rows, int(pixels[n, 1] // cell_px) + 1)
    counts = np.zeros((rows, columns), np.int32)
    ranks = np.empty(len(pixels), np.int32)
    for n in range(len(pixels)):
        row, column = int(pixels[n, 1] // cell_px), int(pixels[n, 0] // cell_px)
        ranks[n] = counts[row, column]
        counts[row, column] += 1
    return ranks
