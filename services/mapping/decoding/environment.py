"""What the features of new anchors start with (paper Eq. 7), by the setting `anchors.features`.

"environment" is the paper's view-dependent environment compensation: an MLP embeds the anchor's
colour and the direction that its keyframe saw it in. It learns with the map: while an anchor is
young, the gradient at its features is also the gradient at its embedding. "colours" keeps what
seeding wrote, one colour per child and noise behind them; "both" puts the embedding behind them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.anchors.anchor_map import FEATURES, AnchorMap
from services.mapping.config import LearningRates, MappingConfig
from services.mapping.decoding.decoders import Visible
from services.mapping.decoding.weight_adam import WeightAdam

SEEN = 6  # colour and unit direction from the camera
_HIDDEN = 32
_YOUNG_STEPS = 100
_WARM_UP_STEPS = 200
_WARM_UP_BATCH = 1024
_NOISE = 0.1


class Environment:
    """Embed of Eq. 7 with its optimizer; without the setting, it does nothing."""

    def __init__(self, config: MappingConfig, seed: int, device: torch.device) -> None:
        self._kind = config.anchors.features
        self._colours = 3 * config.anchors.children
        self._generator = torch.Generator().manual_seed(seed)
        self._weights: dict[str, Tensor] = {}
        if self._kind in ("environment", "both"):
            weights = _initial_weights(self._generator)
            self._weights = {n: w.to(device).requires_grad_() for n, w in weights.items()}
            self._optimizer = WeightAdam(self._weights)
            self._warm_up(device, config.rates)

    @torch.no_grad()
    def initialise(self, anchors: AnchorMap, count: int, centre: NDArray[np.float64]) -> None:
        """Give the last `count` anchors, seen from a camera at `centre` [3], their features."""
        if self._kind == "colours" or count == 0:
            return
        rows, new = anchors.rows, slice(len(anchors) - count, len(anchors))
        features = rows["features"][new]
        if self._kind == "random":
            noise = torch.randn(count, self._colours, generator=self._generator) * _NOISE
            features[:, : self._colours] = noise.to(features)
            return
        colours = torch.sigmoid(features[:, : self._colours]).view(count, -1, 3).mean(1)
        direction = rows["position"][new] - torch.from_numpy(centre).to(features)
        direction = torch.nn.functional.normalize(direction, dim=1)
        rows["seen"][new] = torch.cat([colours, direction], 1)
        first = 0 if self._kind == "environment" else self._colours
        features[:, first:] = self._embed(rows["seen"][new])[:, first:]

    @torch.enable_grad()
    def step(self, anchors: AnchorMap, visible: Visible, rates: LearningRates) -> None:
        """Learn from the gradients at the features of the young anchors in view."""
        if not self._weights:
            return
        index = visible.index
        seen = anchors.rows["seen"][index]
        is_young = (anchors.rows["steps"][index] < _YOUNG_STEPS) & (seen != 0).any(1)
        if not bool(is_young.any()):
            return
        gradient = visible.features.grad[is_young]  # pyright: ignore
        first = 0 if self._kind == "environment" else self._colours
        self._embed(seen[is_young])[:, first:].backward(gradient[:, first:])
        self._step(rates)

    def state(self) -> dict[str, dict[str, Tensor]]:
        """Groups of tensors for a snapshot."""
        groups = {"environment_generator": {"state": self._generator.get_state()}}
        if self._weights:
            weights = {n: w.detach().cpu().clone() for n, w in self._weights.items()}
            groups |= {"environment": weights, "environment_adam": self._optimizer.state()}
        return groups

    @torch.no_grad()
    def restore(self, groups: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Take up a `state()`."""
        self._generator.set_state(groups["environment_generator"]["state"])
        for name, weight in self._weights.items():
            weight.copy_(groups["environment"][name])
        if self._weights:
            self._optimizer.restore(groups["environment_adam"])

    def _embed(self, seen: Tensor) -> Tensor:
        w = self._weights
        hidden = torch.relu(seen @ w["hidden_weight"] + w["hidden_bias"])
        return hidden @ w["output_weight"] + w["output_bias"]

    def _step(self, rates: LearningRates) -> None:
        self._optimizer.step(dict.fromkeys(self._weights, rates.colour_network))

    def _warm_up(self, device: torch.device, rates: LearningRates) -> None:
        """Fit the embedding until the untrained colour network gives back the colours."""
        for _ in range(_WARM_UP_STEPS):
            drawn = torch.randn(_WARM_UP_BATCH, 3, generator=self._generator)
            colours = torch.rand(_WARM_UP_BATCH, 3, generator=self._generator)
            direction = torch.nn.functional.normalize(drawn, dim=1)
            features = self._embed(torch.cat([colours, direction], 1).to(device))
            shown = torch.sigmoid(features[:, : self._colours]).view(_WARM_UP_BATCH, -1, 3)
            (shown - colours.to(device)[:, None]).square().mean().backward()
            self._step(rates)


def _initial_weights(generator: torch.Generator) -> dict[str, Tensor]:
    def normal(rows: int, columns: int) -> Tensor:
        return torch.randn(rows, columns, generator=generator) / rows**0.5

    return {
        "hidden_weight": normal(SEEN, _HIDDEN),
        "hidden_bias": torch.zeros(_HIDDEN),
        "output_weight": normal(_HIDDEN, FEATURES),
        "output_bias": torch.zeros(FEATURES),
    }
