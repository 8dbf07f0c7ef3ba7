"""The map as plain Gaussians with spherical harmonics: what splat viewers show.

Each Gaussian has the place, shape and opacity that the keyframe which made its anchor sees (means
over several keyframes were measured 5 dB further from the map's own renders), and a colour per
direction, fitted to what the networks say of the directions that keyframes saw it from.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from services.mapping.decoding.decoders import decoder_for
from services.mapping.export.harmonics import LeastSquares, basis
from services.mapping.pipeline import Mapper
from services.mapping.rasterizer import Gaussians, View
from services.mapping.views.render import Painter, visible_index
from services.mapping.views.sightings import Sightings
from services.mapping.views.training_views import TrainingView
from shared import se3

MIN_OPACITY = 1.0 / 255.0
_RIDGE = 0.01  # of `LeastSquares`
_MAX_SIGHTS = 24  # of one anchor that are fitted to
_MIN_WEIGHT = 1e-3  # a sight whose depth does not agree still says something where none does
_BLOCK = 1 << 12  # anchors at once; bounds the memory of their normal equations


@dataclass(frozen=True)
class MapCopy:
    """What baking reads of a map, as it was at one moment."""

    painter: Painter
    views: Sequence[TrainingView]
    sightings: Sightings

    @staticmethod
    def of(mapper: Mapper) -> MapCopy:
        """A copy of the parts that drawing needs; not of the optimizer's state."""
        decoder = decoder_for(mapper.config, 0, mapper.anchors.device)
        decoder.restore(mapper.decoder.state())
        painter = replace(mapper.painter, anchors=mapper.anchors.copy(), decoder=decoder)
        return MapCopy(painter, mapper.views.all(), mapper.sightings)

    def centres(self) -> dict[int, Tensor]:
        """Where the cameras of the keyframes are, each [3], by seq."""
        like = self.painter.anchors.rows["position"]
        return {v.seq: torch.from_numpy(v.T_world_camera[:3, 3]).to(like) for v in self.views}


@dataclass(frozen=True)
class BakedGaussians:
    """Gaussians whose colour at a direction is 0.5 + the sum of `harmonics` times the basis."""

    gaussians: Gaussians  # their colours are those that their keyframes see
    harmonics: Tensor  # [N, (degree + 1)^2, 3]

    def seen_from(self, camera_world: Tensor) -> Gaussians:
        """As a viewer shows them to a camera at `camera_world` [3]."""
        means = self.gaussians.means
        directions = torch.nn.functional.normalize(means - camera_world, dim=1)
        degree = round(self.harmonics.shape[1] ** 0.5) - 1
        values = (basis(directions, degree)[:, :, None] * self.harmonics).sum(1)
        return replace(self.gaussians, colours=(values + 0.5).clamp_min(0.0))


def bake(copy: MapCopy, degree: int) -> Iterator[BakedGaussians]:
    """All Gaussians of a map that show, a block of anchors at a time; harmonics up to `degree`."""
    total = len(copy.painter.anchors)
    for block in torch.arange(total, device=copy.painter.anchors.device).split(_BLOCK):
        if len(block) > 0:
            yield _baked(copy, block, degree)


@torch.no_grad()
def _baked(copy: MapCopy, block: Tensor, degree: int) -> BakedGaussians:
    """The Gaussians of anchors that show."""
    made, children = as_made(copy, block), copy.painter.anchors.config.children
    fitted = _fitted(copy, block, made.colours.view(len(block), -1), degree)
    harmonics = fitted.view(len(block), -1, children, 3).transpose(1, 2).flatten(0, 1)
    shows = made.opacities > MIN_OPACITY
    return BakedGaussians(
        Gaussians(*(tensor[shows] for tensor in made.tensors())), harmonics[shows]
    )


def as_made(copy: MapCopy, block: Tensor) -> Gaussians:
    """The Gaussians of anchors, as the keyframes that made them see them."""
    creators, centres = copy.painter.anchors.rows["creator"][block], copy.centres()
    children = copy.painter.anchors.config.children
    seqs, counts = creators.unique(return_counts=True)
    order = creators.argsort(stable=True)
    found = [
        copy.painter.gaussians(block[mine], centres[seq])[1].tensors()
        for seq, mine in zip(seqs.tolist(), order.split(counts.tolist()), strict=True)
    ]
    back = order.argsort()
    joined = (torch.cat(tensors) for tensors in zip(*found, strict=True))
    return Gaussians(*(t.view(len(block), children, -1)[back].view(t.shape) for t in joined))


def _fitted(copy: MapCopy, block: Tensor, colours: Tensor, degree: int) -> Tensor:
    """Coefficients of the children of anchors, [A, (degree + 1)^2, children * 3].

    `colours` [A, children * 3] are those that the keyframes which made them see; they are the
    first sight of each, so that no Gaussian is without.
    """
    rows, centres = copy.painter.anchors.rows, copy.centres()
    position = rows["position"][block]
    fit = LeastSquares(len(block), colours.shape[1], degree, _RIDGE)
    made_from = torch.stack([centres[seq] for seq in rows["creator"][block].tolist()])
    weights = torch.full_like(position[:, 0], _MIN_WEIGHT)
    fit.add(torch.arange(len(block)), position - made_from, colours - 0.5, weights)
    sights = torch.zeros(len(block), dtype=torch.int64)
    for view in _shuffled(copy.views):
        camera = View(se3.inverse(view.T_world_camera), copy.sightings.camera)
        inside = visible_index(position, camera, len(block))
        inside = inside[sights[inside] < _MAX_SIGHTS]
        if len(inside) == 0:
            continue
        agreement = copy.sightings.agreement(position[inside].cpu().numpy(), view)
        weights = torch.from_numpy(agreement).to(position).clamp_min(_MIN_WEIGHT)
        seen = copy.painter.gaussians(block[inside], centres[view.seq])[1].colours
        fit.add(
            inside,
            position[inside] - centres[view.seq],
            seen.view_as(colours[inside]) - 0.5,
            weights,
        )
        sights[inside] += (weights > 0.5).long()
    return fit.solve()


def _shuffled(views: Sequence[TrainingView]) -> list[TrainingView]:
    """Keyframes in an order whose beginning has views from everywhere; always the same one."""
    order = np.random.default_rng(0).permutation(len(views))
    return [views[i] for i in order.tolist()]
