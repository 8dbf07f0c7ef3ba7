"""Our own threads for what torch and BLAS do on one: array work in pieces that free the GIL.

Pieces have a fixed size, whatever the number of threads, so that sums over pieces do not depend
on the machine. OpenMP threads spin at their barriers and were measured to be ten times slower
beside other work.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

R = TypeVar("R")


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def in_pieces(work: Callable[[int, int], R], total: int, size: int) -> list[R]:
    """`work(start, stop)` for each piece of `range(total)`, results in order."""
    starts = range(0, total, size)
    if len(starts) < 2 or num_cores() < 2:
        return [work(start, min(start + size, total)) for start in starts]
    return list(_pool().map(lambda start: work(start, min(start + size, total)), starts))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_cores(), thread_name_prefix="pieces")
