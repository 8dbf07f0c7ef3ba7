"""Gaussians without networks: the parameters of every child are columns of its anchor.

The paper's ablation "without neural Gaussians" (Table 5). Colours do not depend on the view, as
with spherical harmonics of degree 0. Columns are relative to how a child starts, so that new rows
start at zero; their activations are those of 3D Gaussian Splatting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from services.mapping.anchors.anchor_map import AnchorMap, trained_widths
from services.mapping.anchors.quaternions import product
from services.mapping.rasterizer import Gaussians


@dataclass(frozen=True)
class PlainAnchors:
    """The anchors that one view needs, copied out of the map."""

    index: Tensor  # [V], rows of the map
    positions: Tensor  # [V, 3]
    turns_world: Tensor  # [V, 4], unit quaternions wxyz: how anchors were turned since they came
    scalings: Tensor  # [V, 6], not trained: units of the offsets and of the sizes, log metres
    colours: Tensor  # [V, k * 3], logits
    offsets: Tensor  # [V, k * 3]
    opacities: Tensor  # [V, k], logits above the initial one
    sizes: Tensor  # [V, k * 3], log, above the initial size
    turns: Tensor  # [V, k * 4], quaternions wxyz less the identity

    @staticmethod
    def gather(anchors: AnchorMap, index: Tensor, is_trained: bool) -> PlainAnchors:
        """Copy rows `index`; the trained columns become leaves of the gradient."""
        rows = anchors.rows
        trained = {
            name: rows[name][index].requires_grad_(is_trained)
            for name in trained_widths(anchors.config)
        }
        given = (rows[name][index] for name in ("position", "turn", "scalings"))
        return PlainAnchors(index, *given, **trained)


def decode_plain(visible: PlainAnchors, initial_opacity: float) -> Gaussians:
    """The k Gaussians of each visible anchor; row i * k + j is child j of anchor i."""
    count, k = visible.opacities.shape
    sizes = visible.scalings[:, None].exp()
    means = visible.positions[:, None] + visible.offsets.view(count, k, 3) * sizes[..., :3]
    start = math.log(initial_opacity / (1.0 - initial_opacity))
    scales = 0.5 * sizes[..., 3:] * visible.sizes.view(count, k, 3).exp()
    own = visible.turns.view(count, k, 4) + visible.turns.new_tensor([1.0, 0.0, 0.0, 0.0])
    quats = product(visible.turns_world[:, None], own)
    return Gaussians(
        means=means.reshape(-1, 3),
        scales=scales.reshape(-1, 3),
        quats_wxyz=quats.reshape(-1, 4),
        opacities=torch.sigmoid(visible.opacities + start).reshape(-1),
        colours=torch.sigmoid(visible.colours).reshape(-1, 3),
    )
