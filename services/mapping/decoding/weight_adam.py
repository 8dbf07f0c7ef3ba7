"""Adam (Kingma and Ba 2015) over the weights of small networks.

The first optimizer of `torch.optim` imports torch's compiler: 70 MB and a second that a mapper
never uses.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from services.mapping.decoding.optimizer import BETA_MEAN, BETA_SQUARE, drop_faults

_EPSILON = 1e-15


class WeightAdam:
    """Steps named weights, each at its own rate, by the gradients that they have."""

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        self._weights = dict(weights)
        self._means = {name: torch.zeros_like(weight) for name, weight in weights.items()}
        self._squares = {name: torch.zeros_like(weight) for name, weight in weights.items()}
        self._steps = dict.fromkeys(weights, 0)

    @torch.no_grad()
    def step(self, rates: Mapping[str, float]) -> None:
        """One step of every weight with a gradient, which is dropped; `rates` has one for each.

        A slope that is no number counts as 0.
        """
        drop_faults(self._weights.values())
        for name, weight in self._weights.items():
            if weight.grad is not None:
                self._step(name, weight, weight.grad, rates[name])
                weight.grad = None

    def _step(self, name: str, weight: Tensor, gradient: Tensor, rate: float) -> None:
        self._steps[name] += 1
        t, mean, square = self._steps[name], self._means[name], self._squares[name]
        mean.lerp_(gradient, 1.0 - BETA_MEAN)
        square.mul_(BETA_SQUARE).addcmul_(gradient, gradient, value=1.0 - BETA_SQUARE)
        root = square.sqrt().div_((1.0 - BETA_SQUARE**t) ** 0.5).add_(_EPSILON)
        weight.addcdiv_(mean, root, value=-rate / (1.0 - BETA_MEAN**t))

    def state(self) -> dict[str, Tensor]:
        """Copies of steps and moments on the host, as `index.moment`; of those that stepped."""
        return {
            f"{index}.{moment}": value
            for index, name in enumerate(self._weights)
            if self._steps[name]
            for moment, value in (
                ("step", torch.tensor(float(self._steps[name]))),
                ("exp_avg", self._means[name].cpu().clone()),
                ("exp_avg_sq", self._squares[name].cpu().clone()),
            )
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Take up a `state()`."""
        for index, name in enumerate(self._weights):
            if f"{index}.step" in state:
                self._steps[name] = int(state[f"{index}.step"])
                self._means[name].copy_(state[f"{index}.exp_avg"])
                self._squares[name].copy_(state[f"{index}.exp_avg_sq"])
