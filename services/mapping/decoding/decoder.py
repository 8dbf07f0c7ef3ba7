"""The networks that turn visible anchors into Gaussians (paper Eq. 4 to 6), in plain torch.

Three networks share the shape Linear, ReLU, Linear; their hidden layers are kept as one matrix.
The colour network has a linear skip from the features, whose first 3k entries start as the
children's logit colours: without it, a map is grey for its first thousands of iterations.
`decoder_cpu` has the same mathematics for CPUs; a test holds them together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from services.mapping.anchors.anchor_map import FEATURES, AnchorMap, trained_widths
from services.mapping.anchors.quaternions import product, rotate_back
from services.mapping.config import AnchorConfig, DecoderConfig, LearningRates
from services.mapping.decoding.weight_adam import WeightAdam
from services.mapping.rasterizer import Gaussians

VIEW = 4  # direction and distance from camera to anchor
DISTANCE_SCALE = 0.2  # per metre, so that indoor distances are about 1
WEIGHTS = (
    "hidden_weight",
    "hidden_bias",
    "opacity_weight",
    "opacity_bias",
    "colour_weight",
    "colour_bias",
    "covariance_weight",
    "covariance_bias",
    "skip_weight",
)
Weights = dict[str, Tensor]


@dataclass(frozen=True)
class VisibleAnchors:
    """The anchors that one view needs, copied out of the map."""

    index: Tensor  # [V], rows of the map
    positions: Tensor  # [V, 3]
    turns: Tensor  # [V, 4], unit quaternions wxyz: how anchors were turned since they came
    features: Tensor  # [V, 32]
    offsets: Tensor  # [V, k * 3]
    scalings: Tensor  # [V, 6]

    @staticmethod
    def gather(anchors: AnchorMap, index: Tensor, is_trained: bool) -> VisibleAnchors:
        """Copy rows `index`; the trained columns become leaves of the gradient."""
        rows = anchors.rows
        trained = {
            name: rows[name][index].requires_grad_(is_trained)
            for name in trained_widths(anchors.config)
        }
        return VisibleAnchors(index, rows["position"][index], rows["turn"][index], **trained)


def initial_weights(anchors: AnchorConfig, decoder: DecoderConfig, seed: int) -> Weights:
    """Weights that give every child its initial opacity and the colour of its features."""
    k, h = anchors.children, decoder.hidden
    inputs = FEATURES + VIEW
    generator = torch.Generator().manual_seed(seed)

    def normal(rows: int, columns: int, sigma: float) -> Tensor:
        return torch.randn(rows, columns, generator=generator) * sigma

    return {
        "hidden_weight": normal(inputs, 3 * h, 1.0 / math.sqrt(inputs)),
        "hidden_bias": torch.zeros(3 * h),
        "opacity_weight": normal(h, k, 0.01),
        "opacity_bias": torch.full((k,), math.atanh(anchors.initial_opacity)),
        "colour_weight": normal(h, 3 * k, 0.01),
        "colour_bias": torch.zeros(3 * k),
        "covariance_weight": normal(h, 7 * k, 0.01),
        "covariance_bias": torch.zeros(7 * k),
        "skip_weight": torch.eye(FEATURES, 3 * k),
    }


def weight_optimizer(weights: Weights) -> WeightAdam:
    """Adam over the networks."""
    return WeightAdam({name: weights[name] for name in WEIGHTS})


def weight_rates(rates: LearningRates) -> dict[str, float]:
    """The learning rate of each of the networks' weights."""
    per_network = {
        "hidden": rates.covariance_network,
        "opacity": rates.opacity_network,
        "colour": rates.colour_network,
        "covariance": rates.covariance_network,
        "skip": rates.opacity_network,
    }
    return {name: per_network[name.split("_")[0]] for name in WEIGHTS}


def decode(
    visible: VisibleAnchors, camera_world: Tensor, weights: Mapping[str, Tensor]
) -> Gaussians:
    """The k Gaussians of each visible anchor, as a camera at `camera_world` [3] sees them.

    A child whose opacity comes out negative gets zero and is not drawn. Rows are anchor-major:
    child j of anchor i is row i * k + j.
    """
    k = visible.offsets.shape[1] // 3
    hidden = _hidden(visible, camera_world, weights).chunk(3, dim=1)
    opacities = torch.tanh(hidden[0] @ weights["opacity_weight"] + weights["opacity_bias"])
    colours = hidden[1] @ weights["colour_weight"] + weights["colour_bias"]
    colours = torch.sigmoid(colours + visible.features @ weights["skip_weight"])
    covariance = hidden[2] @ weights["covariance_weight"] + weights["covariance_bias"]
    sizes = visible.scalings[:, None].exp()
    shares = torch.sigmoid(covariance[:, : 3 * k]).view(-1, k, 3)
    means = visible.positions[:, None] + visible.offsets.view(-1, k, 3) * sizes[..., :3]  # Eq. 5
    own = covariance[:, 3 * k :].view(-1, k, 4) + covariance.new_tensor([1.0, 0.0, 0.0, 0.0])
    quats = product(visible.turns[:, None], own)
    return Gaussians(
        means=means.reshape(-1, 3),
        scales=(shares * sizes[..., 3:]).reshape(-1, 3),
        quats_wxyz=quats.reshape(-1, 4),
        opacities=opacities.clamp_min(0.0).reshape(-1),
        colours=colours.reshape(-1, 3),
    )


def _hidden(visible: VisibleAnchors, camera_world: Tensor, weights: Mapping[str, Tensor]) -> Tensor:
    direction = visible.positions - camera_world
    distance = direction.norm(dim=1, keepdim=True)
    direction = rotate_back(visible.turns, direction / distance.clamp_min(1e-6))
    view = [direction, distance * DISTANCE_SCALE]
    inputs = torch.cat([visible.features, *view], 1)
    return torch.relu(inputs @ weights["hidden_weight"] + weights["hidden_bias"])
