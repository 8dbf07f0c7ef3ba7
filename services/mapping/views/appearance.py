"""Exposure of each keyframe as a gain and a bias per colour channel, learned with the map.

Images of other times get an interpolated exposure; without a time the mean one. The first
keyframe keeps the identity: it says what the map's colours mean.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.mapping.config import LearningRates
from services.mapping.decoding.optimizer import BETA_MEAN, BETA_SQUARE, EPSILON

IDENTITY = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]], np.float32)  # gain, bias


class ExposureModel:
    """Exposures by keyframe seq, each [2, 3]: gain, then bias; seqs come in order of time."""

    def __init__(self) -> None:
        self._times: dict[int, int] = {}  # seq to t_ns
        self._rows: dict[int, NDArray[np.float32]] = {}  # [3, 2, 3]: value and Adam's moments
        self._steps: dict[int, int] = {}

    def add(self, seq: int, t_ns: int) -> None:
        """A new keyframe starts with the exposure of the one before it."""
        before = self.of(next(reversed(self._rows))) if self._rows else IDENTITY
        self._rows[seq] = np.stack([before, 0 * IDENTITY, 0 * IDENTITY])
        self._times[seq] = t_ns
        self._steps[seq] = 0

    def set(self, seq: int, exposure: NDArray[np.float32]) -> None:
        """Replace the exposure [2, 3] of a keyframe that has not been trained on, not the first."""
        if seq != next(iter(self._rows)):
            self._rows[seq][0] = exposure

    def of(self, seq: int) -> NDArray[np.float32]:
        """Exposure of a keyframe, [2, 3]."""
        return self._rows[seq][0].copy()

    def at(self, t_ns: int | None) -> NDArray[np.float32]:
        """Exposure at a time, linear between keyframes; the mean one for None. [2, 3]."""
        if not self._rows:
            return IDENTITY
        values = np.stack([row[0] for row in self._rows.values()])
        if t_ns is None:
            return values.mean(0)
        times = np.array(list(self._times.values()), np.int64)
        seconds = (times - times[0]) * 1e-9
        at = (t_ns - int(times[0])) * 1e-9
        columns = values.reshape(len(values), 6).T
        mixed = [np.interp(at, seconds, column) for column in columns]
        return np.array(mixed, np.float32).reshape(2, 3)

    def step(self, seq: int, gradient: NDArray[np.float32], rates: LearningRates) -> None:
        """One step of Adam for a keyframe's exposure; `gradient` is [2, 3], finite or ignored."""
        if seq == next(iter(self._rows)) or not np.isfinite(gradient).all():
            return
        self._steps[seq] += 1
        value, mean, square = self._rows[seq]
        mean += (1.0 - BETA_MEAN) * (gradient - mean)
        square += (1.0 - BETA_SQUARE) * (gradient * gradient - square)
        corrected = mean / (1.0 - BETA_MEAN ** self._steps[seq])
        root = np.sqrt(square) / math.sqrt(1.0 - BETA_SQUARE ** self._steps[seq])
        own = np.array([[rates.exposure_gain], [rates.exposure_bias]], np.float32)
        value -= own * corrected / (root + EPSILON)

    def state(self) -> dict[str, np.ndarray]:
        """Everything, as arrays."""
        return {
            "seqs": np.array(list(self._rows), np.int64),
            "times": np.array(list(self._times.values()), np.int64),
            "steps": np.array(list(self._steps.values()), np.int64),
            "rows": np.array(list(self._rows.values()), np.float32).reshape(-1, 3, 2, 3),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Replace everything by a `state()`."""
        seqs = state["seqs"].tolist()
        self._times = dict(zip(seqs, state["times"].tolist(), strict=True))
        self._steps = dict(zip(seqs, state["steps"].tolist(), strict=True))
        self._rows = {seq: row.copy() for seq, row in zip(seqs, state["rows"], strict=True)}
