"""Adam over the rows that an iteration saw (Kingma and Ba 2015), with step counts per row."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

from services.mapping.rows import RowTable
from services.mapping.workers import in_pieces

BETA_MEAN = 0.9
BETA_SQUARE = 0.999
EPSILON = 1e-12
_PIECE = 4096


@dataclass(frozen=True)
class RowStep:
    """One step of the rows that an iteration saw."""

    rows: RowTable
    index: Tensor  # [V], without repeats
    corrections: Tensor  # [V, 2], bias corrections 1 / (1 - beta^t) of mean and square


def begin_step(rows: RowTable, index: Tensor) -> RowStep:
    """Count one more step for the rows `index` [V]."""
    steps = rows["steps"][index] + 1
    rows["steps"][index] = steps
    t = steps.double()
    corrections = torch.stack([1.0 / (1.0 - BETA_MEAN**t), 1.0 / (1.0 - BETA_SQUARE**t)], 1)
    return RowStep(rows, index, corrections.float())


def adam_rows(step: RowStep, name: str, gradient: Tensor, rate: float) -> None:
    """Step column `name` with `gradient` [V, D] and its moments `name_mean`, `name_square`.

    The step is scaled by the column `rate` of each row. Rows that are not named keep everything.
    """
    if gradient.device.type == "cpu":
        _adam_cpu(step, name, gradient, rate)
    else:
        adam_rows_torch(step, name, gradient, rate)


def adam_rows_torch(step: RowStep, name: str, gradient: Tensor, rate: float) -> None:
    """`adam_rows` in plain torch, for any device."""
    rows, index, corrections = step.rows, step.index, step.corrections
    mean = rows[f"{name}_mean"][index].lerp(gradient, 1.0 - BETA_MEAN)
    square = rows[f"{name}_square"][index].lerp(gradient * gradient, 1.0 - BETA_SQUARE)
    rows[f"{name}_mean"][index] = mean
    rows[f"{name}_square"][index] = square
    change = corrections[:, :1] * mean / ((square * corrections[:, 1:]).sqrt() + EPSILON)
    rows[name][index] -= rate * rows["rate"][index, None] * change


def _adam_cpu(step: RowStep, name: str, slope: Tensor, rate: float) -> None:
    rows, index, gradient = step.rows, step.index.numpy(), slope.numpy()
    value, mean, square = (rows[f"{name}{end}"].numpy() for end in ("", "_mean", "_square"))
    rates = (rate * rows["rate"][step.index] * step.corrections[:, 0]).numpy()
    squares = step.corrections[:, 1].numpy()

    def work(start: int, stop: int) -> None:
        part = index[start:stop], gradient[start:stop], rates[start:stop], squares[start:stop]
        _adam_kernel(part, (value, mean, square))

    in_pieces(work, len(index), _PIECE)


@numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _adam_kernel(part, columns):  # pragma: no cover - compiled
    """Rows of (index, gradient, rate, correction) into the columns (value, mean, square)."""
    index, gradient, rates, corrections = part
    value, mean, square = columns
    one = np.float32(1.0)
    b1, b2, epsilon = np.float32(BETA_MEAN), np.float32(BETA_SQUARE), np.float32(EPSILON)
    for row in range(index.size):
        i = index[row]
        for d in range(gradient.shape[1]):
            g = gradient[row, d]
            m = b1 * mean[i, d] + (one - b1) * g
            v = b2 * square[i, d] + (one - b2) * g * g
            mean[i, d] = m
            square[i, d] = v
            value[i, d] -= rates[row] * m / (np.sqrt(v * corrections[row]) + epsilon)
