"""A pool of threads for kernels that release the interpreter lock.

Work is cut into pieces of a fixed size that the threads take from a shared counter, so results
do not depend on the number of threads. Numba's own `prange` refuses two Python threads at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np

MAX_THREADS = 8


class Workers:
    """Runs a kernel on several threads at once; callers on different threads may share it."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(max(1, threads - 1), thread_name_prefix="raster")

    def run(self, kernel: Callable, *arguments: object) -> None:
        """Call `kernel(*arguments, counter)` on every thread, with one counter that starts at 0."""
        counter = np.zeros(1, np.int64)
        others = [self._pool.submit(kernel, *arguments, counter) for _ in range(self.threads - 1)]
        kernel(*arguments, counter)
        for other in others:
            other.result()


def default_threads() -> int:
    """One per core that this process may use, at most 8."""
    return min(MAX_THREADS, len(os.sched_getaffinity(0)))


@cache
def workers(threads: int) -> Workers:
    """The process's pool of that many threads, the caller's included."""
    return Workers(threads)
