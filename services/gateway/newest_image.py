"""The newest colour image of a session, small, for those who watch."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import cv2
import numpy as np

from shared import images
from shared.camera import Intrinsics
from shared.frames import ColourImage

_MAX_WIDTH_PX = 480
_JPEG_QUALITY = 80


@dataclass(frozen=True)
class SmallImage:
    """A JPEG of at most 480 px width, and the frame it is of."""

    seq: int
    jpeg: bytes


class NewestImage:
    """Keeps one encoded image; it is made small when somebody looks, once for all who do."""

    def __init__(self, size: Intrinsics) -> None:
        self._size = size
        self._newest: tuple[int, ColourImage] | None = None
        self._small: SmallImage | None = None
        self._shrinking = asyncio.Lock()

    def keep(self, seq: int, image: ColourImage) -> None:
        """Take a newer image."""
        self._newest = seq, image

    async def small(self) -> SmallImage | None:
        """The newest image as a small JPEG; None before the first frame of this gateway.

        Raises:
            InputError: it is damaged.
        """
        async with self._shrinking:
            if self._newest is None:
                return None
            seq, image = self._newest
            if self._small is None or self._small.seq != seq:
                jpeg = await asyncio.to_thread(_small_jpeg, image, self._size)
                self._small = SmallImage(seq, jpeg)
            return self._small


def _small_jpeg(image: ColourImage, size: Intrinsics) -> bytes:
    rgb = images.decode_colour(image, size)
    if size.width > _MAX_WIDTH_PX:
        height = round(size.height * _MAX_WIDTH_PX / size.width)
        small = cv2.resize(rgb, (_MAX_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        rgb = small.astype(np.uint8, copy=False)
    return images.encode_jpeg(rgb, _JPEG_QUALITY).bytes
