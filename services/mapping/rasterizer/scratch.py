"""Large arrays that are kept between calls.

Touching fresh pages costs more than what the kernels write there, and the system clears them one
thread at a time.
"""

from __future__ import annotations

import weakref
from collections import deque
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

CACHE_LINE = 64  # bytes; a record that straddled two would cost two
_MOST = 96  # arrays kept; two whole iterations of the mapper have fewer


class Scratch:
    """Lends arrays, and takes each back when nothing refers to it any more.

    Any thread may borrow, and any thread may be the one that drops the last reference.
    """

    def __init__(self) -> None:
        self._free: deque[NDArray[np.uint8]] = deque(maxlen=_MOST)

    def borrow(self, size: int, dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """An array of `size` numbers that nobody else has, contents arbitrary.

        It starts at a cache line.
        """
        num_bytes = size * np.dtype(dtype).itemsize
        memory = self._take(num_bytes)
        # Not a slice: views of it must keep alive what the finalizer watches, not its owner.
        lent = np.frombuffer(memory.data[:num_bytes], dtype)
        weakref.finalize(lent, self._free.append, memory).atexit = False
        return lent

    def _take(self, num_bytes: int) -> NDArray[np.uint8]:
        """A free array that is large enough, but not far too large, or a new one."""
        for _ in range(len(self._free)):
            try:
                memory = self._free.popleft()
            except IndexError:
                break
            if num_bytes <= memory.size <= 2 * num_bytes + 4096:
                return memory
            self._free.append(memory)
        memory = np.empty(num_bytes + num_bytes // 4 + CACHE_LINE, np.uint8)
        return memory[-memory.ctypes.data % CACHE_LINE :]


@cache
def scratch() -> Scratch:
    """The process's arrays."""
    return Scratch()
