"""A pool of threads for kernels that release the interpreter lock.

Work is cut into pieces of a fixed size that the threads take from a shared counter, so results
do not depend on the number of threads. Numba's own `prange` refuses two Python threads at once.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from queue import SimpleQueue

import numpy as np

MAX_THREADS = 8


@dataclass(frozen=True)
class _Job:
    """A kernel that helpers may join; each that does takes a ticket and reports when it is done."""

    kernel: Callable
    arguments: tuple
    tickets: deque[int]
    reports: SimpleQueue[BaseException | None] = field(default_factory=SimpleQueue)

    def help(self) -> None:
        """Join, unless the caller has already done all of the work."""
        try:
            self.tickets.pop()
        except IndexError:
            return
        try:
            self.kernel(*self.arguments)
        except BaseException as error:  # the caller raises it
            self.reports.put(error)
        else:
            self.reports.put(None)

    def finish(self) -> None:
        """Wait for the helpers that have joined, and for no other; raise what they raised."""
        most, unused = self.tickets.maxlen or 0, 0
        while self.tickets:
            try:
                self.tickets.pop()
            except IndexError:  # a helper was faster
                break
            unused += 1
        for error in [self.reports.get() for _ in range(most - unused)]:
            if error is not None:
                raise error


class Workers:
    """Runs a kernel on several threads at once; callers on different threads may share it.

    Where the helpers are busy for another caller, the caller does its work alone.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        for number in range(1, threads):
            name = f"raster-{number}"
            threading.Thread(target=_help, args=(self._jobs,), name=name, daemon=True).start()

    def run(self, kernel: Callable, *arguments: object) -> None:
        """Call `kernel(*arguments, counter)` on every thread, with one counter that starts at 0."""
        helpers = self.threads - 1
        counter = np.zeros(1, np.int64)
        job = _Job(kernel, (*arguments, counter), deque(range(helpers), helpers))
        for _ in range(helpers):
            self._jobs.put(job)
        try:
            kernel(*job.arguments)
        finally:
            job.finish()


def _help(jobs: SimpleQueue[_Job]) -> None:
    while True:
        jobs.get().help()


def default_threads() -> int:
    """One per core that this process may use, at most 8."""
    return min(MAX_THREADS, len(os.sched_getaffinity(0)))


@cache
def workers(threads: int) -> Workers:
    """The process's pool of that many threads, the caller's included."""
    return Workers(threads)
