"""Turns at the map: the worker takes it for one step at a time and lets visitors go first.

A plain lock would do for correctness, but Python's are unfair: a worker that releases and takes
it again in a loop keeps a waiting render out for seconds.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Turns:
    """Exclusive use of something; visitors wait for one step of the worker at most."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._is_taken = False
        self._visitors = 0

    @contextmanager
    def visit(self) -> Iterator[None]:
        """Exclusive use, before the worker's next step."""
        with self._condition:
            self._visitors += 1
            self._condition.wait_for(lambda: not self._is_taken)
            self._visitors -= 1
            self._is_taken = True
        try:
            yield
        finally:
            self._release()

    @contextmanager
    def step(self) -> Iterator[None]:
        """Exclusive use for one step of the worker, when no visitor waits."""
        with self._condition:
            self._condition.wait_for(lambda: not self._is_taken and self._visitors == 0)
            self._is_taken = True
        try:
            yield
        finally:
            self._release()

    def _release(self) -> None:
        with self._condition:
            self._is_taken = False
            self._condition.notify_all()
