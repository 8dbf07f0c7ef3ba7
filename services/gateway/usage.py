"""Whether anybody uses a session."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Usage:
    """Who uses something at present, and since when nobody does."""

    def __init__(self) -> None:
        self._users = 0
        self._used_s = time.monotonic()

    @contextmanager
    def held(self) -> Iterator[None]:
        """In use while the block runs."""
        self._users += 1
        try:
            yield
        finally:
            self._users -= 1
            self.touch()

    def touch(self) -> None:
        """Note that somebody asked for it."""
        self._used_s = time.monotonic()

    @property
    def idle_s(self) -> float:
        """How long nobody has used it; 0 while somebody does."""
        return 0.0 if self._users else time.monotonic() - self._used_s
