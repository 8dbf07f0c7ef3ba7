"""Answered frames on their way to the owner of the map: in order, each until acknowledged."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from contextvars import Context

from services.gateway.config import MappingConfig
from services.gateway.owner import MapOwner
from shared.errors import (
    ClaimLostError,
    ConflictError,
    InputError,
    PointSlamError,
    UnavailableError,
)
from shared.tracing import outgoing, under
from shared.tracks import Advance

LOGGER = logging.getLogger(__name__)
_USUAL_STEP = 0.1  # weight of the newest time in the mean


class Delivery:
    """The unacknowledged entries of a live session, a bounded ring, and the task that sends them.

    When the ring is full the next frame waits, so a map without an owner slows its session down
    and loses nothing.
    """

    def __init__(self, owner: MapOwner, config: MappingConfig) -> None:
        self._owner = owner
        self._config = config
        self._entries: deque[tuple[Advance, str]] = deque()  # with their traces
        self._task: asyncio.Task[None] | None = None
        self._changed = asyncio.Condition()
        self._failure: PointSlamError | None = None
        self._usual_s = 0.0  # what an entry takes at present

    def __len__(self) -> int:
        return len(self._entries)

    async def put(self, entry: Advance) -> None:
        """Add an entry; waits while the ring is full.

        Raises:
            ClaimLostError: another gateway advances the session by now.
            PointSlamError: the ring is full because the owner refuses what is in it.
        """
        if isinstance(self._failure, ClaimLostError):
            raise self._failure
        async with self._changed:
            while len(self._entries) >= self._config.live_entries:
                if self._failure is not None:
                    raise self._failure
                await self._changed.wait()
        self._entries.append((entry, outgoing()))
        if self._task is None or self._task.done():
            # In no frame's context: it sends those of others too.
            self._task = asyncio.create_task(self._send_all(), context=Context())

    async def flush(self, timeout_s: float) -> bool:
        """Wait until all entries are acknowledged; false when the time was over first."""
        try:
            async with asyncio.timeout(timeout_s), self._changed:
                await self._changed.wait_for(lambda: not self._entries)
        except TimeoutError:
            return False
        return True

    @property
    def holds_keyframe(self) -> bool:
        """Whether a keyframe waits that trackers cannot see in the map yet."""
        return any(entry.keyframe is not None for entry, _ in self._entries)

    @property
    def problem(self) -> PointSlamError | None:
        """Why the map does not grow at present; None when it does."""
        if self._entries and self._owner.lost.is_set():
            return UnavailableError("the map has no owner at present")
        return self._failure

    async def settle(self) -> None:
        """Wait until all entries are acknowledged or refused, or the map has lost its owner.

        Not much longer than that takes at present: an owner that is gone must not hold poses up.
        """
        usual_s = self._config.keyframe_wait_ratio * self._usual_s
        timeout_s = min(
            max(self._config.keyframe_wait_s, usual_s), self._config.keyframe_max_wait_s
        )
        ends = [
            asyncio.create_task(self._taken_or_refused()),
            asyncio.create_task(self._owner.lost.wait()),
        ]
        await asyncio.wait(ends, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
        for end in ends:
            end.cancel()

    def give_up(self) -> None:
        """Send nothing more and forget what is not acknowledged; new entries may come."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
        self._forget()
        self._failure = None

    def _forget(self) -> None:
        if self._entries:
            LOGGER.warning("%s: %d frames not delivered", self._owner.session, len(self._entries))
        self._entries.clear()

    async def _taken_or_refused(self) -> None:
        async with self._changed:
            await self._changed.wait_for(lambda: not self._entries or self._failure is not None)

    async def _send_all(self) -> None:
        while self._entries:
            entry, traceparent = self._entries[0]
            try:
                if entry.record.seq > self._owner.logged_seq:
                    with under(traceparent):
                        await self._advance(entry)
            except ClaimLostError as error:
                self._forget()
                await self._tell(error)
                return
            except (InputError, ConflictError) as error:
                # It would be refused for ever, and everything behind it would wait.
                name, seq = self._owner.session, entry.record.seq
                LOGGER.error("%s: frame %d is not in the map: %s", name, seq, error)
            except PointSlamError as error:
                if str(error) != str(self._failure):
                    LOGGER.warning("%s: map entry not taken: %s", self._owner.session, error)
                await self._tell(error)
                await asyncio.sleep(self._config.retry_s)
                continue
            self._entries.popleft()
            await self._tell(None)

    async def _advance(self, entry: Advance) -> None:
        start_s = time.monotonic()
        await self._owner.advance(entry)
        if entry.keyframe is not None:
            took_s = min(time.monotonic() - start_s, self._config.keyframe_max_wait_s)
            self._usual_s += _USUAL_STEP * (took_s - self._usual_s)

    async def _tell(self, failure: PointSlamError | None) -> None:
        self._failure = failure
        async with self._changed:
            self._changed.notify_all()
