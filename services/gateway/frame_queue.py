"""The frames of one session on their way to a tracker: one in flight, the others in order."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from services.gateway.errors import OrderError
from services.gateway.metrics import FRAME_SECONDS, FRAMES
from shared.errors import PointSlamError, UnavailableError
from shared.frames import TrackingStatus
from shared.stream import FrameMessage, FrameReply

LOGGER = logging.getLogger(__name__)

Outcome = FrameReply | PointSlamError


@dataclass(frozen=True)
class _Waiting:
    message: FrameMessage
    outcome: asyncio.Future[Outcome]
    since_s: float


class FrameQueue:
    """Admits frames in order and answers one at a time.

    Live: one frame waits, and a newer one takes its place; the older is answered SUPERSEDED.
    Offline: up to `max_waiting` frames wait for their turn.
    """

    def __init__(
        self,
        answer: Callable[[FrameMessage, float], Awaitable[FrameReply]],
        is_live: bool,
        max_waiting: int,
        newest: tuple[int, int] = (-1, -1),
    ) -> None:
        self._answer = answer
        self._is_live = is_live
        self._max_waiting = max_waiting
        self._answered = newest  # seq and t_ns of the newest frame that was answered
        self._waiting: deque[_Waiting] = deque()
        self._in_flight: _Waiting | None = None
        self._task: asyncio.Task[None] | None = None

    def submit(self, message: FrameMessage) -> asyncio.Future[Outcome]:
        """Queue a frame; its answer, or the error that refused it, comes in the future.

        Raises:
            OrderError: `seq` or `t_ns` does not grow; nothing changes.
            UnavailableError: too many frames wait.
        """
        self._check_order(message)
        if self._is_live:
            self._supersede()
        elif len(self._waiting) >= self._max_waiting:
            raise UnavailableError(f"{len(self._waiting)} frames of this session wait already")
        future: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        admitted = _Waiting(message, future, time.perf_counter())
        if self._in_flight is None:
            self._in_flight = admitted  # at once: no later frame may take its place
            self._task = asyncio.create_task(self._work())
        else:
            self._waiting.append(admitted)
        return future

    @property
    def is_empty(self) -> bool:
        """Whether no frame waits or is under way."""
        return self._in_flight is None and not self._waiting

    @property
    def age_s(self) -> float:
        """Since when the oldest unanswered frame is here; 0 without one."""
        return 0.0 if self._in_flight is None else time.perf_counter() - self._in_flight.since_s

    async def finish(self) -> None:
        """Wait until every frame that is here now is answered, whatever comes after."""
        admitted = [*self._waiting, *([self._in_flight] if self._in_flight else [])]
        if admitted:
            await asyncio.wait([waiting.outcome for waiting in admitted])

    def resume(self, newest: tuple[int, int]) -> None:
        """Go on behind the newest answered frame (seq, t_ns), whoever answered it."""
        self._answered = newest

    def refuse(self, reason: PointSlamError) -> None:
        """Stop; frames that are under way or wait are refused. New ones may come."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
        if self._in_flight is not None:
            self._waiting.appendleft(self._in_flight)
            self._in_flight = None
        while self._waiting:
            _settle(self._waiting.popleft(), reason)

    def _check_order(self, message: FrameMessage) -> None:
        seq, t_ns = self._newest()
        if message.seq <= seq:
            raise OrderError("seq", f"must be more than {seq}, got {message.seq}")
        if message.t_ns <= t_ns:
            raise OrderError("t_ns", f"must be more than {t_ns}, got {message.t_ns}")

    def _newest(self) -> tuple[int, int]:
        newest = self._waiting[-1] if self._waiting else self._in_flight
        if newest is None:
            return self._answered
        return max(self._answered, (newest.message.seq, newest.message.t_ns))

    def _supersede(self) -> None:
        while self._waiting:
            old = self._waiting.popleft()
            status = TrackingStatus.SUPERSEDED
            _settle(old, FrameReply(old.message.seq, old.message.t_ns, status))

    async def _work(self) -> None:
        while (current := self._in_flight) is not None:
            _settle(current, await self._outcome(current))
            self._in_flight = self._waiting.popleft() if self._waiting else None

    async def _outcome(self, current: _Waiting) -> Outcome:
        waited_ms = 1e3 * (time.perf_counter() - current.since_s)
        FRAME_SECONDS.labels("queue").observe(waited_ms / 1e3)
        try:
            reply = await self._answer(current.message, waited_ms)
        except PointSlamError as error:
            # A refused frame does not count: its number may come again with good content.
            return error
        except Exception:
            # A fault of ours must not leave the sender waiting or end the session.
            LOGGER.exception("frame %d: the answer failed", current.message.seq)
            return PointSlamError("internal error; see the gateway's log")
        self._answered = (current.message.seq, current.message.t_ns)
        return reply


def _settle(waiting: _Waiting, outcome: Outcome) -> None:
    if not waiting.outcome.done():
        waiting.outcome.set_result(outcome)
        is_answered = isinstance(outcome, FrameReply)
        FRAMES.labels(str(outcome.status) if is_answered else "refused").inc()
        FRAME_SECONDS.labels("total").observe(time.perf_counter() - waiting.since_s)
