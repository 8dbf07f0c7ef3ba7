"""Times of one frame's stages; a stage entered twice counts twice.

Stages that run side by side on two threads have names of their own: their times add up to more
than the total.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Milliseconds of named stages of one frame."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._milliseconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block."""
        start = time.perf_counter()
        yield
        elapsed = 1e3 * (time.perf_counter() - start)
        self._milliseconds[name] = self._milliseconds.get(name, 0.0) + elapsed

    def times(self) -> dict[str, float]:
        """All stages so far, and the total since the watch was made."""
        return {**self._milliseconds, "total": 1e3 * (time.perf_counter() - self._start)}
