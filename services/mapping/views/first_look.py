"""A new keyframe beside what the map drew there before it: drawn once, at half the size.

What the map lacks (`coverage`), the keyframe's exposure (`exposure_fit`) and the colours that young
anchors take over at once (`colour_fusion`) are all read from this one render.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.decoding.decoders import Visible
from services.mapping.rasterizer import Rendered, View, WeightedSums
from services.mapping.views.render import Painter
from shared import se3
from shared.rectify import RgbdImage


@dataclass(frozen=True)
class FirstLook:
    """A keyframe at half its size, and the map's view from its pose."""

    rgb: NDArray[np.float32]  # [H, W, 3], 0 to 1
    depth_m: NDArray[np.float32]  # [H, W], nearest readings, 0 where there is none
    visible: Visible
    colours: Tensor  # [V * k, 3], of the children
    rendered: Rendered
    weighted_sums: WeightedSums  # over the children
    moving: NDArray[np.bool_] | None  # [H, W], pixels that do not count

    def depth_drawn_m(self) -> NDArray[np.float32]:
        """The map's depth, [H, W]; meaningless where alpha is low."""
        alpha = self.rendered.alpha.clamp_min(1e-6)
        return (self.rendered.depth / alpha).cpu().numpy()


@torch.no_grad()
def first_look(
    painter: Painter, image: RgbdImage, T_world_camera: NDArray[np.float64]
) -> FirstLook:
    """Draw the map as a keyframe sees it."""
    half = image.intrinsics.scaled(0.5)
    view = View(se3.inverse(T_world_camera), half)
    visible, gaussians = painter.decode(view, is_trained=False)
    rendered, sums = painter.rasterizer.with_sums(gaussians, view)
    rgb = cv2.resize(image.rgb, (half.width, half.height), interpolation=cv2.INTER_AREA)
    depth_m = resized(image.depth_m, half.height, half.width)
    moving = None if image.moving is None else resized(image.moving, half.height, half.width)
    return FirstLook(
        rgb=rgb.astype(np.float32) / 255.0,
        depth_m=depth_m,
        visible=visible,
        colours=gaussians.colours,
        rendered=rendered,
        weighted_sums=sums,
        moving=moving,
    )


def resized(image: NDArray, height: int, width: int) -> NDArray:
    """The image at another size, nearest pixels."""
    rows = (2 * np.arange(height) + 1) * image.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * image.shape[1] // (2 * width)
    return image[rows[:, None], columns]
