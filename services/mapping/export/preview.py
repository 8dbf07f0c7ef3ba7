"""The map as few plain Gaussians, quick to make: what a page shows while the map still grows."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from services.mapping.export.baking import MIN_OPACITY, BakedGaussians, MapCopy, as_made
from services.mapping.export.harmonics import CONSTANT
from services.mapping.rasterizer import Gaussians

_BLOCK = 1 << 14  # anchors at once
_MAX_GROWTH = 3.0  # of a side
_NOTHING = ((0, 3), (0, 3), (0, 4), (0,), (0, 3))


@torch.no_grad()
def preview(copy: MapCopy, limit: int) -> BakedGaussians:
    """At most `limit` Gaussians that stand for all, with the colours that their keyframes see."""
    device, total = copy.painter.anchors.device, len(copy.painter.anchors)
    sample = Sample(limit, device)
    for block in torch.arange(total, device=device).split(_BLOCK):
        if len(block) > 0:
            sample.add(as_made(copy, block))
    kept = sample.grown()
    return BakedGaussians(kept, ((kept.colours - 0.5) / CONSTANT)[:, None])


class Sample:
    """A random part of Gaussians that are seen once, grown so that it covers what all did.

    "Stochastic simplification of aggregate detail" (Cook et al., 2007). Each is drawn by a clock of
    its own (Efraimidis and Spirakis, 2006) that runs the faster the more it covers, but only with
    the root: where the map is fine the sample is finer too. The largest alone would leave holes
    there.
    """

    def __init__(self, limit: int, device: torch.device | str = "cpu") -> None:
        self._limit = limit
        self._random = torch.Generator().manual_seed(0)  # the same map gives the same preview
        self._kept = Gaussians(*(torch.zeros(shape, device=device) for shape in _NOTHING))
        self._clocks = torch.zeros(0, device=device)
        self._end = math.inf  # the first clock of those left out

    def add(self, more: Gaussians) -> None:
        """Draw among these and those kept so far."""
        chance = torch.rand(len(more.means), generator=self._random).to(more.means.device)
        clocks = -chance.clamp(min=1e-12).log() / _rate(more)
        both = [torch.cat(pair) for pair in zip(self._kept.tensors(), more.tensors(), strict=True)]
        clocks = torch.cat([self._clocks, clocks])
        order = clocks.argsort()
        order = order[clocks[order] < math.inf]
        kept, dropped = order[: self._limit], order[self._limit :]
        self._kept = Gaussians(*(tensor[kept] for tensor in both))
        self._clocks = clocks[kept]
        if len(dropped) > 0:
            self._end = min(self._end, float(clocks[dropped[0]]))

    def grown(self) -> Gaussians:
        """Those kept, their two larger sides grown by what was left out around them."""
        kept = self._kept
        share = -torch.expm1(-_rate(kept) * self._end)
        growth = share.rsqrt().clamp(max=_MAX_GROWTH)[:, None]
        is_thin = kept.scales == kept.scales.amin(dim=1, keepdim=True)
        scales = torch.where(is_thin, kept.scales, growth * kept.scales)
        return Gaussians(kept.means, scales, kept.quats_wxyz, kept.opacities, kept.colours)


def _rate(gaussians: Gaussians) -> Tensor:
    """Root of opacity times the area of the largest side, [N]; 0 where it cannot show."""
    largest = gaussians.scales.topk(2, dim=1).values
    covered = gaussians.opacities * largest[:, 0] * largest[:, 1]
    return covered.sqrt().where(gaussians.opacities > MIN_OPACITY, torch.zeros_like(covered))
