"""Large arrays that are kept between calls."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray


class Scratch:
    """Lends float32 arrays; touching fresh pages costs more than what kernels write there."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._free: list[NDArray[np.float32]] = []

    @contextmanager
    def borrow(self, size: int) -> Iterator[NDArray[np.float32]]:
        """An array of at least `size` numbers that nobody else has, contents arbitrary."""
        with self._lock:
            array = self._free.pop() if self._free else np.empty(0, np.float32)
        if array.size < size:
            array = np.empty(size + size // 4, np.float32)
        try:
            yield array
        finally:
            with self._lock:
                self._free.append(array)
