"""One question asked of several workers, each beside those before it that are still silent."""

from __future__ import annotations

import asyncio
import time
from typing import Generic, TypeVar

T = TypeVar("T")


class Race(Generic[T]):
    """Questions under way, by worker; whoever answers first ends it."""

    def __init__(self) -> None:
        self._since_s: dict[str, float] = {}
        self._asked: dict[asyncio.Future[T], str] = {}

    @property
    def workers(self) -> set[str]:
        """Workers that were asked and have not ended."""
        return set(self._asked.values())

    def enter(self, worker: str, question: asyncio.Future[T]) -> None:
        """One more worker, that was asked a question just now."""
        self._asked[question] = worker
        self._since_s[worker] = time.monotonic()

    async def ended(self, timeout_s: float) -> list[tuple[str, asyncio.Future[T]]]:
        """Workers that have answered or failed; none when the time was over first."""
        done, _ = await asyncio.wait(
            self._asked, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED
        )
        return [(self._asked.pop(question), question) for question in done]

    def silent(self, longer_than_s: float) -> list[str]:
        """Workers that have had so much time and are still under way."""
        now = time.monotonic()
        return [w for w in self._asked.values() if now - self._since_s[w] > longer_than_s]

    def close(self) -> None:
        """Wait for nobody any more."""
        for question in self._asked:
            question.cancel()
        self._asked.clear()
