"""Adam over the rows that an iteration saw (Kingma and Ba 2015), with step counts per row."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

from services.mapping.anchors.rows import RowTable
from services.mapping.rasterizer.memory import fetch_add
from services.mapping.rasterizer.threads import default_threads, workers

BETA_MEAN = 0.7  # each step shows another view: with 0.9, steps go on where the last views pulled
BETA_SQUARE = 0.999
EPSILON = 1e-12
STEEPEST = 1e15  # a slope beyond is a fault: its square would end every later step of its row
_PIECE = 1024


@dataclass(frozen=True)
class Youth:
    """How much wider rows step while they are young: 1 + `boost` exp(-t / `steps`)."""

    boost: float = 0.0
    steps: float = 10.0


@dataclass(frozen=True)
class RowStep:
    """One step of the rows that an iteration saw."""

    rows: RowTable
    index: Tensor  # [V], without repeats
    rates: Tensor  # [V], of the row and its youth, over 1 - beta^t of the mean
    corrections: Tensor  # [V], 1 / (1 - beta^t) of the square


def begin_step(rows: RowTable, index: Tensor, youth: Youth = Youth()) -> RowStep:
    """Count one more step for the rows `index` [V]."""
    if index.device.type == "cpu":
        rates, corrections = torch.empty(len(index)), torch.empty(len(index))
        columns = rows["steps"].numpy(), rows["rate"].numpy()
        young = youth.boost, youth.steps
        _begin_kernel(index.numpy(), columns, young, rates.numpy(), corrections.numpy())
        return RowStep(rows, index, rates, corrections)
    steps = rows["steps"][index] + 1
    rows["steps"][index] = steps
    t = steps.double()
    young = 1.0 + youth.boost * torch.exp(-t / youth.steps)
    rates = rows["rate"][index] * young / (1.0 - BETA_MEAN**t)
    return RowStep(rows, index, rates.float(), (1.0 / (1.0 - BETA_SQUARE**t)).float())


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _begin_kernel(index, columns, young, rates, corrections):  # pragma: no cover - compiled
    """Count a step of each row; rates and corrections as in `RowStep`, `young` as in `Youth`."""
    steps, row_rates = columns
    boost, span = young
    for row in range(index.size):
        i = index[row]
        steps[i] += 1
        youth = 1.0 + boost * np.exp(-steps[i] / span)
        rates[row] = row_rates[i] * youth / (1.0 - BETA_MEAN ** steps[i])
        corrections[row] = 1.0 / (1.0 - BETA_SQUARE ** steps[i])


def adam_rows(step: RowStep, name: str, gradient: Tensor, rate: float) -> None:
    """Step column `name` with `gradient` [V, D] and its moments `name_mean`, `name_square`.

    The step is scaled by the column `rate` of each row. Rows that are not named keep everything.
    A slope that is no number, or so large that its square is none, counts as 0.
    """
    if gradient.device.type == "cpu":
        _adam_cpu(step, name, gradient, rate)
    else:
        adam_rows_torch(step, name, gradient, rate)


def drop_faults(parameters: Iterable[Tensor]) -> None:
    """Let slopes that are no numbers count as 0, before an optimizer of torch steps on them."""
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad.nan_to_num_(0.0, 0.0, 0.0)


def adam_rows_torch(step: RowStep, name: str, gradient: Tensor, rate: float) -> None:
    """`adam_rows` in plain torch, for any device."""
    rows, index, corrections = step.rows, step.index, step.corrections
    gradient = torch.where(gradient.abs() < STEEPEST, gradient, 0.0)
    mean = rows[f"{name}_mean"][index].lerp(gradient, 1.0 - BETA_MEAN)
    square = rows[f"{name}_square"][index].lerp(gradient * gradient, 1.0 - BETA_SQUARE)
    rows[f"{name}_mean"][index] = mean
    rows[f"{name}_square"][index] = square
    change = step.rates[:, None] * mean / ((square * corrections[:, None]).sqrt() + EPSILON)
    rows[name][index] -= rate * change


def _adam_cpu(step: RowStep, name: str, slope: Tensor, rate: float) -> None:
    rows, index, gradient = step.rows, step.index.numpy(), slope.numpy()
    columns = tuple(rows[f"{name}{end}"].numpy() for end in ("", "_mean", "_square"))
    part = index, gradient, step.rates.numpy(), step.corrections.numpy()
    workers(default_threads()).run(_adam_kernel, part, columns, np.float32(rate))


@numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _adam_kernel(part, columns, rate, counter):  # pragma: no cover - compiled
    """Rows of (index, gradient, rate, correction) into the columns (value, mean, square)."""
    index, gradient, rates, corrections = part
    value, mean, square = columns
    one = np.float32(1.0)
    b1, b2, epsilon = np.float32(BETA_MEAN), np.float32(BETA_SQUARE), np.float32(EPSILON)
    steepest = np.float32(STEEPEST)
    while True:
        start = fetch_add(counter, 0, _PIECE)
        if start >= index.size:
            return
        for row in range(start, min(start + _PIECE, index.size)):
            i, row_rate = index[row], rate * rates[row]
            for d in range(gradient.shape[1]):
                g = gradient[row, d]
                if not abs(g) < steepest:
                    g = np.float32(0.0)
                m = b1 * mean[i, d] + (one - b1) * g
                v = b2 * square[i, d] + (one - b2) * g * g
                mean[i, d] = m
                square[i, d] = v
                value[i, d] -= row_rate * m / (np.sqrt(v * corrections[row]) + epsilon)
