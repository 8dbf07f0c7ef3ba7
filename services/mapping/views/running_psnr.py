"""How near the map is to the views that it was last trained on."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

_WINDOW = 50  # training views


class RunningPsnr:
    """Mean PSNR of the last training views."""

    def __init__(self) -> None:
        self._squared_errors: deque[float] = deque(maxlen=_WINDOW)

    def add(self, squared_error: float) -> None:
        """A training view's mean squared error, of colours from 0 to 1."""
        self._squared_errors.append(squared_error)

    @property
    def mean_db(self) -> float | None:
        """None before the first view."""
        if not self._squared_errors:
            return None
        errors = np.maximum(np.array(self._squared_errors), 1e-10)
        return float(np.mean(-10.0 * np.log10(errors)))

    def state(self) -> NDArray[np.float64]:
        """The squared errors, oldest first."""
        return np.array(self._squared_errors, np.float64)

    def restore(self, state: NDArray[np.float64]) -> None:
        """Replace everything by a `state()`."""
        self._squared_errors = deque(state.tolist(), maxlen=_WINDOW)
