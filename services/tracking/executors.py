"""Threads beside the one that tracks a frame; or none, for whoever wants one thing at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class NoHelper(Executor):
    """An executor without threads: what is submitted runs at once, in the caller's."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run now; an exception waits in the future, as it would from a thread."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # handed on by result()
            future.set_exception(error)
        return future


def taken_over(future: Future[T], work: Callable[[], T]) -> T:
    """The result of a task; done here where its thread has not come to it yet."""
    return work() if future.cancel() else future.result()


class Once(Generic[T]):
    """Work for the thread that first asks for its result; others that ask meanwhile wait."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work
        self._lock = threading.Lock()
        self._results: list[T] = []

    def result(self) -> T:
        """What the work gave; an error is raised to everyone who asks."""
        with self._lock:
            if not self._results:
                self._results.append(self._work())
            return self._results[0]
