"""Young anchors take over what a new keyframe sees, before any step of the optimizer.

A pixel is linear in the colours of the Gaussians that it shows, so that one step of Jacobi's
method, each colour by the mean residual under its own weights, comes near the least squares.
Anchors that have learned for long hardly move: they know the mean of many views.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.anchors.anchor_map import AnchorMap
from services.mapping.losses.mapping_loss import Appearance
from services.mapping.views.first_look import FirstLook

_COLOUR_MARGIN = 0.02  # logits of pure black and white would be infinite
_LEAST_WEIGHT_PX = 0.5  # a child that shows less of itself than this moves by less


def fuse_colours(
    anchors: AnchorMap,
    look: FirstLook,
    is_covered: NDArray[np.bool_],
    appearance: Appearance,
    half_steps: float,
) -> None:
    """Move the colours of the anchors in a look toward the keyframe's.

    Args:
        is_covered: pixels that show what the map draws there, [H, W].
        appearance: of the keyframe.
        half_steps: an anchor that has taken so many steps of Adam goes half the way.
    """
    if half_steps <= 0 or len(look.visible.index) == 0:
        return
    if look.moving is not None:
        is_covered = is_covered & ~look.moving
    moves = _moves(look, torch.from_numpy(is_covered), appearance)
    steps = anchors.rows["steps"][look.visible.index]
    shares = half_steps / (half_steps + steps.float())
    colours = look.colours.clamp(_COLOUR_MARGIN, 1.0 - _COLOUR_MARGIN)
    moved = colours + moves * shares.repeat_interleave(anchors.config.children)[:, None]
    moved = moved.clamp(_COLOUR_MARGIN, 1.0 - _COLOUR_MARGIN)
    change = (torch.logit(moved) - torch.logit(colours)).view(len(steps), -1)
    anchors.add_to_logit_colours(look.visible.index, change.nan_to_num(0.0))


def _moves(look: FirstLook, is_covered: Tensor, appearance: Appearance) -> Tensor:
    """Mean residual under the weights of each child, as colours of the map, [V * k, 3]."""
    rgb = torch.from_numpy(look.rgb).to(look.colours)
    open_share = (1.0 - look.rendered.alpha)[..., None]
    composite = look.rendered.colour + open_share * appearance.background
    residuals = (rgb - appearance.exposure[1]) / appearance.exposure[0] - composite
    counted = is_covered[..., None].to(rgb)
    sums = look.weighted_sums(torch.cat([residuals * counted, counted], dim=2))
    return sums[:, :3] / (sums[:, 3:] + _LEAST_WEIGHT_PX)
