"""Large arrays that are kept between calls.

Touching fresh pages costs more than what the kernels write there, and the system clears them one
thread at a time.
"""

from __future__ import annotations

import threading
import weakref
from collections import deque
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

CACHE_LINE = 64  # bytes; a record that straddled two would cost two
MOST_BYTES = 160 << 20  # kept between calls: an iteration has 60 to 140 MB, now and then a view 300
MOST_IN_ALL = 256 << 20  # lent and kept together: what is lent beyond leaves nothing idle beside it
_MOST = 96  # arrays kept; two whole iterations of the mapper have fewer


class Scratch:
    """Lends arrays, and takes each back when nothing refers to it any more.

    Any thread may borrow, and any thread may be the one that drops the last reference.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._free: list[NDArray[np.uint8]] = []  # longest ago used first
        self._num_bytes_lent = 0
        # The last reference may go at any moment, even to the thread that holds the lock.
        self._returned: deque[NDArray[np.uint8]] = deque()

    def borrow(self, size: int, dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """An array of `size` numbers that nobody else has, contents arbitrary.

        It starts at a cache line.
        """
        num_bytes = size * np.dtype(dtype).itemsize
        memory = self._take(num_bytes)
        # Not a slice: views of it must keep alive what the finalizer watches, not its owner.
        lent = np.frombuffer(memory.data[:num_bytes], dtype)
        weakref.finalize(lent, self._returned.append, memory).atexit = False
        return lent

    @property
    def num_bytes(self) -> int:
        """What is kept for the next call."""
        with self._lock:
            self._collect()
            return sum(memory.size for memory in self._free)

    def release(self) -> None:
        """Keep nothing for the next call: memory is wanted elsewhere."""
        with self._lock:
            self._collect()
            self._let_go(0)

    def _take(self, num_bytes: int) -> NDArray[np.uint8]:
        """The least free array that is large enough, but not far too large, or a new one."""
        with self._lock:
            self._collect()
            sizes = [memory.size for memory in self._free]
            fitting = [s for s in sizes if num_bytes <= s <= 2 * num_bytes + 4096]
            if fitting:
                memory = self._free.pop(sizes.index(min(fitting)))
            else:
                fresh_bytes = num_bytes + num_bytes // 4 + CACHE_LINE
                self._let_go(min(MOST_BYTES, MOST_IN_ALL - self._num_bytes_lent - fresh_bytes))
                fresh = np.empty(fresh_bytes, np.uint8)
                memory = fresh[-fresh.ctypes.data % CACHE_LINE :]
            self._num_bytes_lent += memory.size
            return memory

    def _collect(self) -> None:
        """Take up what came back; let go of what is too much."""
        while self._returned:
            memory = self._returned.popleft()
            self._num_bytes_lent -= memory.size
            self._free.append(memory)
        self._let_go(MOST_BYTES)

    def _let_go(self, most_bytes: int) -> None:
        """Keep no more than this for the next call, what was used last."""
        total = sum(memory.size for memory in self._free)
        while self._free and (total > most_bytes or len(self._free) > _MOST):
            total -= self._free.pop(0).size


@cache
def scratch() -> Scratch:
    """The process's arrays."""
    return Scratch()
