"""Adam over network weights: as torch's own, and a saved one goes on as if it never stopped."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from services.mapping.decoding.optimizer import BETA_MEAN, BETA_SQUARE
from services.mapping.decoding.weight_adam import WeightAdam

RATES = {"weight": 0.01, "bias": 0.002}


def weights() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    shapes = {"weight": (5, 4), "bias": (4,)}
    return {
        name: torch.randn(shape, generator=generator).requires_grad_()
        for name, shape in shapes.items()
    }


def slope(named: dict[str, Tensor], step: int) -> None:
    """Give every weight the gradient of that step."""
    generator = torch.Generator().manual_seed(step)
    for weight in named.values():
        weight.grad = torch.randn(weight.shape, generator=generator)


def test_it_steps_as_torchs_adam():
    ours, theirs = weights(), weights()
    groups = [{"params": [theirs[name]], "lr": RATES[name]} for name in theirs]
    betas = BETA_MEAN, BETA_SQUARE
    adam, twin = WeightAdam(ours), torch.optim.Adam(groups, betas=betas, eps=1e-15)

    for step in range(50):
        slope(ours, step)
        slope(theirs, step)
        adam.step(RATES)
        twin.step()

    for name in ours:
        torch.testing.assert_close(ours[name], theirs[name], rtol=1e-5, atol=1e-6)


def test_a_restored_one_goes_on_to_the_bit():
    whole, first = weights(), weights()
    adam, early = WeightAdam(whole), WeightAdam(first)
    for step in range(3):
        slope(whole, step)
        slope(first, step)
        adam.step(RATES)
        early.step(RATES)

    later = WeightAdam(first)
    later.restore(early.state())
    slope(whole, 3)
    slope(first, 3)
    adam.step(RATES)
    later.step(RATES)

    assert all(torch.equal(whole[name], first[name]) for name in whole)


def test_a_slope_that_is_no_number_counts_as_zero():
    named = weights()
    before = named["bias"].detach().clone()
    named["bias"].grad = torch.full((4,), math.nan)

    WeightAdam(named).step(RATES)

    assert torch.equal(named["bias"], before)


def test_a_weight_without_a_gradient_stays():
    named = weights()
    before = {name: weight.detach().clone() for name, weight in named.items()}

    WeightAdam(named).step(RATES)

    assert all(torch.equal(named[name], before[name]) for name in named)
