"""The frame streams of this gateway: they end together, each with its replies delivered."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager


class OpenStreams:
    """Counts streams, and tells them that the gateway is ending."""

    def __init__(self) -> None:
        self.ending = asyncio.Event()  # take no more frames
        self._count = 0

    @contextmanager
    def joined(self) -> Iterator[None]:
        """One more while the block runs."""
        self._count += 1
        try:
            yield
        finally:
            self._count -= 1

    async def finish(self, timeout_s: float) -> None:
        """Let every stream answer what it has taken, and no more; returns when all have gone."""
        self.ending.set()
        deadline = asyncio.get_running_loop().time() + timeout_s
        while self._count and asyncio.get_running_loop().time() < deadline:
            await asyncio.sleep(_LOOK_S)


_LOOK_S = 0.02
