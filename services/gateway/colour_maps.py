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


def picture(
    reply: RenderReply, layer: str, depth_range_m: tuple[float, float] | None = None
) -> Picture:
    """One layer of a render; black where nothing is drawn.

    Without a range the colours of depth stand for what this render shows.

    Raises:
        InputError: there is no such layer.
    """
    if layer == "colour":
        return Picture(reply.rgb)
    if layer == "confidence":
        return Picture(_coloured(reply.confidence, cv2.COLORMAP_VIRIDIS, reply.alpha > 0))
    if layer == "depth":
        return _depth(reply.depth_m, depth_range_m)
    raise InputError("layer", f"must be one of {', '.join(LAYERS)}, got {layer[:40]!r}")


def depth_range(depth_m: NDArray[np.float32]) -> tuple[float, float] | None:
    """What the first and the last colour shall stand for, metres; None where nothing is drawn."""
    is_drawn = depth_m > 0
    if not is_drawn.any():
        return None
    near, far = np.percentile(depth_m[is_drawn], _RANGE_PERCENT)
    return float(near), float(far)


def _depth(depth_m: NDArray[np.float32], range_m: tuple[float, float] | None) -> Picture:
    is_drawn = depth_m > 0
    near, far = range_m or depth_range(depth_m) or (0.0, 0.0)
    share = (depth_m - near) / max(far - near, 1e-3)
    grey = np.rint(255.0 * (1.0 - share.clip(0.0, 1.0))).astype(np.uint8)  # near is warm
    return Picture(_coloured(grey, cv2.COLORMAP_TURBO, is_drawn), (near, far))


def _coloured(grey: NDArray[np.uint8], colours: int, is_drawn: NDArray) -> NDArray[np.uint8]:
    rgb = cv2.applyColorMap(grey, colours)[..., ::-1]
    return np.where(is_drawn[..., None], rgb, np.uint8(0))
