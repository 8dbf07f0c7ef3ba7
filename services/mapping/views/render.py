"""Views of the map: which anchors a camera needs, their Gaussians, and the rendered images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.anchors.anchor_map import AnchorMap
from services.mapping.config import DecoderConfig
from services.mapping.decoding.decoders import Decoder, Visible
from services.mapping.losses.mapping_loss import Appearance
from services.mapping.rasterizer import Gaussians, Rasterizer, Rendered, View

MIN_DEPTH_M = 0.2
MARGIN_PX = 24.0  # an anchor's children reach into the image from outside
_MIN_ALPHA = 0.5 / 255.0


@dataclass(frozen=True)
class Drawn:
    """A rendered view with all that led to it."""

    visible: Visible
    gaussians: Gaussians
    rendered: Rendered


@dataclass(frozen=True)
class Painter:
    """The map's parts that drawing needs."""

    anchors: AnchorMap
    decoder: Decoder
    rasterizer: Rasterizer
    config: DecoderConfig

    def decode(self, view: View, is_trained: bool) -> tuple[Visible, Gaussians]:
        """The Gaussians of the anchors in a view (Eq. 4 to 6)."""
        positions = self.anchors.rows["position"]
        index = visible_index(positions, view, self.config.max_visible_anchors)
        camera = torch.from_numpy(camera_world(view)).to(positions)
        return self.gaussians(index, camera, is_trained)

    def gaussians(
        self, index: Tensor, camera: Tensor, is_trained: bool = False
    ) -> tuple[Visible, Gaussians]:
        """`Decoder.decode`, with opacities that anchors lost by halving."""
        visible, gaussians = self.decoder.decode(self.anchors, index, camera, is_trained)
        if not self.anchors.is_gated:
            return visible, gaussians
        gates = self.anchors.rows["gate"][index].repeat_interleave(self.anchors.config.children)
        return visible, replace(gaussians, opacities=gaussians.opacities * gates)

    @torch.no_grad()
    def draw(self, view: View) -> Drawn:
        """Render without gradients."""
        visible, gaussians = self.decode(view, is_trained=False)
        return Drawn(visible, gaussians, self.rasterizer(gaussians, view))


def camera_world(view: View) -> np.ndarray:
    """Position of a view's camera in the world, [3]."""
    T = np.asarray(view.T_camera_world)
    return -T[:3, :3].T @ T[:3, 3]


def visible_index(positions: Tensor, view: View, limit: int) -> Tensor:
    """Which of `positions` [N, 3] are inside a view, ascending; the nearest `limit` at most."""
    T = torch.from_numpy(np.asarray(view.T_camera_world)).to(positions)
    points = positions @ T[:3, :3].T + T[:3, 3]
    depth = points[:, 2].clamp_min(1e-6)
    k = view.intrinsics
    u = points[:, 0] / depth * k.fx + k.cx
    v = points[:, 1] / depth * k.fy + k.cy
    is_inside = points[:, 2] > MIN_DEPTH_M
    is_inside &= (u > -MARGIN_PX) & (u < k.width + MARGIN_PX)
    is_inside &= (v > -MARGIN_PX) & (v < k.height + MARGIN_PX)
    index = is_inside.nonzero()[:, 0]
    if len(index) > limit:
        index = index[depth[index].argsort(stable=True)[:limit]].sort().values
    return index


class Images(NamedTuple):
    """A view as it is given away."""

    rgb: NDArray[np.uint8]  # [H, W, 3]
    depth_m: NDArray[np.float32]  # [H, W], along the optical axis, 0 where nothing is drawn
    alpha: NDArray[np.uint8]  # [H, W]


def to_images(drawn: Drawn, appearance: Appearance) -> Images:
    """8-bit colour, depth along the axis, and alpha; a view of nothing is black."""
    rendered = drawn.rendered
    alpha = rendered.alpha.clamp(0.0, 1.0)
    image = appearance.apply(rendered.colour, alpha).clamp(0.0, 1.0)
    if len(drawn.visible.index) == 0:
        image = torch.zeros_like(image)
    is_drawn = alpha > _MIN_ALPHA
    depth = torch.where(is_drawn, rendered.depth / alpha.clamp_min(_MIN_ALPHA), 0.0)
    return Images(_bytes(image), depth.cpu().numpy(), _bytes(alpha))


def _bytes(image: Tensor) -> np.ndarray:
    return (image * 255.0).round().to(torch.uint8).cpu().numpy()
