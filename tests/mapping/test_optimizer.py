"""Row-wise Adam against torch's, and its laws."""

from __future__ import annotations

import math

import pytest
import torch

from services.mapping.anchors.rows import RowTable
from services.mapping.decoding.optimizer import (
    BETA_MEAN,
    BETA_SQUARE,
    Youth,
    adam_rows,
    adam_rows_torch,
    begin_step,
)

COLUMN = ((3,), torch.float32)


def table(rows: int = 6) -> RowTable:
    columns = {name: COLUMN for name in ("x", "x_mean", "x_square")}
    result = RowTable(
        {**columns, "steps": ((), torch.int64), "rate": ((), torch.float32)}, torch.device("cpu")
    )
    values = torch.randn(rows, 3, generator=torch.Generator().manual_seed(0))
    result.append({"x": values, "rate": torch.ones(rows)})
    return result


def gradients(steps: int, rows: int) -> torch.Tensor:
    return torch.randn(steps, rows, 3, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("function", [adam_rows, adam_rows_torch])
def test_steps_of_all_rows_equal_torchs_adam(function):
    rows, index = table(), torch.arange(6)
    parameter = rows["x"].clone().requires_grad_()
    adam = torch.optim.Adam([parameter], 0.01, (BETA_MEAN, BETA_SQUARE), eps=1e-12)

    for gradient in gradients(20, 6):
        function(begin_step(rows, index), "x", gradient, 0.01)
        parameter.grad = gradient.clone()
        adam.step()

    torch.testing.assert_close(rows["x"], parameter.detach(), rtol=1e-4, atol=1e-6)


def test_the_compiled_kernel_equals_plain_torch_on_some_rows():
    fast, plain, index = table(5000), table(5000), torch.arange(0, 5000, 3)

    for gradient in gradients(3, len(index)):
        adam_rows(begin_step(fast, index), "x", gradient, 0.02)
        adam_rows_torch(begin_step(plain, index), "x", gradient, 0.02)

    for name in ("x", "x_mean", "x_square"):
        torch.testing.assert_close(fast[name], plain[name], rtol=1e-4, atol=1e-6)


def test_rows_that_are_not_seen_keep_value_moments_and_count():
    rows = table()
    before = rows["x"].clone()

    adam_rows(begin_step(rows, torch.tensor([1, 4])), "x", torch.ones(2, 3), 0.1)

    assert torch.equal(rows["x"][[0, 2, 3, 5]], before[[0, 2, 3, 5]])
    assert rows["steps"].tolist() == [0, 1, 0, 0, 1, 0]


def test_the_first_step_is_the_rate_whatever_the_gradients_size():
    rows = table(2)
    before = rows["x"].clone()

    gradient = torch.tensor([[1e-6] * 3, [1e3] * 3])
    adam_rows(begin_step(rows, torch.arange(2)), "x", gradient, 0.1)

    torch.testing.assert_close(before - rows["x"], torch.full((2, 3), 0.1))


def test_a_rows_own_rate_scales_its_steps():
    rows = table(2)
    rows["rate"][1] = 0.1
    before = rows["x"].clone()

    adam_rows(begin_step(rows, torch.arange(2)), "x", torch.ones(2, 3), 0.1)

    torch.testing.assert_close((before - rows["x"])[:, 0], torch.tensor([0.1, 0.01]))


@pytest.mark.parametrize("function", [adam_rows, adam_rows_torch])
def test_young_rows_step_wider_and_settle(function):
    rows, gradient = table(2), torch.ones(1, 3)
    youth = Youth(boost=3.0, steps=2.0)
    moves = []

    for _ in range(9):
        before = rows["x"][0, 0].clone()
        function(begin_step(rows, torch.tensor([0]), youth), "x", gradient, 0.1)
        moves.append(float(before - rows["x"][0, 0]))

    # Under a constant slope, plain Adam moves by its rate.
    expected = [0.1 * (1 + 3 * math.exp(-t / 2)) for t in range(1, 10)]
    assert moves == pytest.approx(expected, rel=1e-3)
