"""How anchors become Gaussians: through the shared networks, or, to compare, without any."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor

from services.mapping.anchors.anchor_map import AnchorMap
from services.mapping.config import LearningRates, MappingConfig
from services.mapping.decoding.cpu import decode_cpu
from services.mapping.decoding.decoder import (
    VisibleAnchors,
    Weights,
    decode,
    initial_weights,
    weight_optimizer,
    weight_rates,
)
from services.mapping.decoding.plain import PlainAnchors, decode_plain
from services.mapping.rasterizer import Gaussians

Groups = dict[str, dict[str, Tensor]]
Visible = VisibleAnchors | PlainAnchors


class Decoder(Protocol):
    """What all anchors share on their way to Gaussians."""

    @property
    def num_bytes(self) -> int:
        """Size of what is shared, without optimizer state."""
        ...

    def decode(
        self, anchors: AnchorMap, index: Tensor, camera_world: Tensor, is_trained: bool = False
    ) -> tuple[Visible, Gaussians]:
        """The k Gaussians of each anchor of rows `index` [V], seen from `camera_world` [3].

        Also the copies of those rows that the Gaussians come from, leaves of the gradient where
        they are trained. Row i * k + j is child j of anchor i.
        """
        ...

    def step(self, rates: LearningRates) -> None:
        """Take one step of Adam with the gradients there are."""
        ...

    def state(self) -> Groups:
        """Groups of tensors for a snapshot."""
        ...

    def restore(self, groups: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Take up a `state()`."""
        ...


def decoder_for(config: MappingConfig, seed: int, device: torch.device) -> Decoder:
    """The decoder that `anchors.gaussians` names."""
    if config.anchors.gaussians == "plain":
        return PlainDecoder(config.anchors.initial_opacity)
    return NeuralDecoder(config, seed, device)


class NeuralDecoder:
    """The networks F_a of Eq. 6 with their optimizer."""

    def __init__(self, config: MappingConfig, seed: int, device: torch.device) -> None:
        weights = initial_weights(config.anchors, config.decoder, seed)
        self.weights: Weights = {n: w.to(device).requires_grad_() for n, w in weights.items()}
        self._optimizer = weight_optimizer(self.weights)
        self._function = decode_cpu if device.type == "cpu" else decode

    @property
    def num_bytes(self) -> int:
        """Size of the weights."""
        return sum(weight.numel() * 4 for weight in self.weights.values())

    def decode(
        self, anchors: AnchorMap, index: Tensor, camera_world: Tensor, is_trained: bool = False
    ) -> tuple[Visible, Gaussians]:
        """As `Decoder.decode`."""
        visible = VisibleAnchors.gather(anchors, index, is_trained)
        return visible, self._function(visible, camera_world, self.weights)

    def step(self, rates: LearningRates) -> None:
        """As `Decoder.step`."""
        self._optimizer.step(weight_rates(rates))

    def state(self) -> Groups:
        """Weights and Adam's moments."""
        weights = {name: weight.detach().cpu().clone() for name, weight in self.weights.items()}
        return {"weights": weights, "adam": self._optimizer.state()}

    @torch.no_grad()
    def restore(self, groups: Mapping[str, Mapping[str, Tensor]]) -> None:
        """As `Decoder.restore`."""
        for name, weight in self.weights.items():
            weight.copy_(groups["weights"][name])
        self._optimizer.restore(groups.get("adam", {}))


class PlainDecoder:
    """No networks: every child's parameters are its own."""

    num_bytes = 0

    def __init__(self, initial_opacity: float) -> None:
        self._initial_opacity = initial_opacity

    def decode(
        self, anchors: AnchorMap, index: Tensor, camera_world: Tensor, is_trained: bool = False
    ) -> tuple[Visible, Gaussians]:
        """As `Decoder.decode`; the same from wherever they are seen."""
        visible = PlainAnchors.gather(anchors, index, is_trained)
        return visible, decode_plain(visible, self._initial_opacity)

    def step(self, rates: LearningRates) -> None:
        """Nothing is shared."""

    def state(self) -> Groups:
        """Nothing is shared."""
        return {}

    def restore(self, groups: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Nothing is shared."""
