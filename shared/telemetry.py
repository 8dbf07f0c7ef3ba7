"""Stage times: how long each step of a pipeline takes."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


class StageTimes:
    """Times of named stages in milliseconds; keeps the last `window` values of each."""

    def __init__(self, window: int = 1000) -> None:
        self._window = window
        self._values: dict[str, deque[float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block and add it under `name`."""
        start = time.perf_counter()
        yield
        self.add(name, 1e3 * (time.perf_counter() - start))

    def add(self, name: str, milliseconds: float) -> None:
        """Add one measured value."""
        self._values.setdefault(name, deque(maxlen=self._window)).append(milliseconds)

    def last(self) -> dict[str, float]:
        """The newest value of each stage."""
        return {name: values[-1] for name, values in list(self._values.items())}

    def medians(self) -> dict[str, float]:
        """The median of each stage over the window."""
        return {name: float(np.median(list(v))) for name, v in list(self._values.items())}
