"""The map as few plain Gaussians, quick to make: what a page shows while the map still grows."""

from __future__ import annotations

import torch
from torch import Tensor

from services.mapping.export.baking import MIN_OPACITY, BakedGaussians, MapCopy, as_made
from services.mapping.export.harmonics import CONSTANT
from services.mapping.rasterizer import Gaussians

_BLOCK = 1 << 14  # anchors at once
_NOTHING = ((0, 3), (0, 3), (0, 4), (0,), (0, 3))


@torch.no_grad()
def preview(copy: MapCopy, limit: int) -> BakedGaussians:
    """The `limit` Gaussians that cover most, with the colours that their keyframes see."""
    device, total = copy.painter.anchors.device, len(copy.painter.anchors)
    most = Gaussians(*(torch.zeros(shape, device=device) for shape in _NOTHING))
    for block in torch.arange(total, device=device).split(_BLOCK):
        if len(block) > 0:
            most = _covering_most(most, as_made(copy, block), limit)
    return BakedGaussians(most, ((most.colours - 0.5) / CONSTANT)[:, None])


def _covering_most(a: Gaussians, b: Gaussians, limit: int) -> Gaussians:
    both = [torch.cat(tensors) for tensors in zip(a.tensors(), b.tensors(), strict=True)]
    covered = _covered(Gaussians(*both))
    best = covered.topk(min(limit, len(covered))).indices
    best = best[covered[best] > 0.0]
    return Gaussians(*(tensor[best] for tensor in both))


def _covered(gaussians: Gaussians) -> Tensor:
    """Opacity times the area of the largest side, up to a factor, [N]; 0 where it cannot show."""
    largest = gaussians.scales.topk(2, dim=1).values
    covered = gaussians.opacities * largest[:, 0] * largest[:, 1]
    return covered.where(gaussians.opacities > MIN_OPACITY, torch.zeros_like(covered))
