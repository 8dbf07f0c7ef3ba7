"""Layers of a render as pictures that people read: depth near to far, confidence none to full."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.errors import InputError
from shared.maps import RenderReply

LAYERS = ("colour", "depth", "confidence")
_RANGE_PERCENT = (1.0, 99.0)  # a few pixels of a far hole must not take all the colours


@dataclass(frozen=True)
class Picture:
    """A layer as colours; of depth, also what the first and the last colour stand for."""

    rgb: NDArray[np.uint8]  # [H, W, 3]
    range_m: tuple[float, float] | None = None


def picture(reply: RenderReply, layer: str) -> Picture:
    """One layer of a render; black where nothing is drawn.

    Raises:
        InputError: there is no such layer.
    """
    if layer == "colour":
        return Picture(reply.rgb)
    if layer == "confidence":
        return Picture(_coloured(reply.confidence, cv2.COLORMAP_VIRIDIS, reply.alpha > 0))
    if layer == "depth":
        return _depth(reply.depth_m)
    raise InputError("layer", f"must be one of {', '.join(LAYERS)}, got {layer[:40]!r}")


def _depth(depth_m: NDArray[np.float32]) -> Picture:
    is_drawn = depth_m > 0
    if not is_drawn.any():
        return Picture(np.zeros((*depth_m.shape, 3), np.uint8), (0.0, 0.0))
    near, far = (float(bound) for bound in np.percentile(depth_m[is_drawn], _RANGE_PERCENT))
    share = (depth_m - near) / max(far - near, 1e-3)
    grey = np.rint(255.0 * (1.0 - share.clip(0.0, 1.0))).astype(np.uint8)  # near is warm
    return Picture(_coloured(grey, cv2.COLORMAP_TURBO, is_drawn), (near, far))


def _coloured(grey: NDArray[np.uint8], colours: int, is_drawn: NDArray) -> NDArray[np.uint8]:
    rgb = cv2.applyColorMap(grey, colours)[..., ::-1]
    return np.where(is_drawn[..., None], rgb, np.uint8(0))
