"""The pool of tracking workers: which one gets a session's frame, and what if it fails.

Sessions stick to a worker by rendezvous hashing, so that its caches stay warm, and a cap on the
load spreads them. A worker that is gone is left at once; beside one that keeps silent another is
asked, and if that answers first, the silent one is left alone for a while. The answer does not
depend on which worker gave it, so nothing is lost by asking twice.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass, replace
from typing import Any

from services.gateway.config import DispatchConfig
from services.gateway.members import Members
from services.gateway.metrics import QUARANTINES, RETRIES
from services.gateway.race import Race
from shared.bus import Bus, Keys
from shared.errors import GoneError, TimedOutError, UnavailableError
from shared.frames import TrackRequest
from shared.localization import LocalizeRequest, LocalizeResult
from shared.tracks import TrackResult

LOGGER = logging.getLogger(__name__)
_USUAL_STEP = 0.1  # weight of the newest time in the mean


def choose(session: str, loads: Mapping[str, int], load_cap: float) -> str:
    """The first worker in the session's own order whose load is below the cap.

    Rendezvous hashing with bounded loads; `loads` counts the sessions of each worker without this
    one.
    """
    cap = math.ceil(load_cap * (sum(loads.values()) + 1) / len(loads))
    order = sorted(loads, key=lambda worker: _weight(session, worker), reverse=True)
    return next(worker for worker in order if loads[worker] < cap)


def _weight(session: str, worker: str) -> bytes:
    return hashlib.blake2b(f"{session}\0{worker}".encode(), digest_size=8).digest()


@dataclass
class _Seat:
    """The worker of one session and when it was last asked."""

    worker: str
    used_s: float


@dataclass(frozen=True)
class Limits:
    """How long one question may take, seconds, and whose it is."""

    timeout_s: float  # of one worker
    wait_s: float  # for a worker to be there
    seat: str  # who sticks to one worker: a session, or one that watches it
    patience_s: float = math.inf  # then another worker is asked beside


class TrackerPool:
    """Asks workers for each session's frames and single images."""

    def __init__(self, bus: Bus, members: Members, config: DispatchConfig) -> None:
        self._bus = bus
        self._members = members
        self._config = config
        self._seats: dict[str, _Seat] = {}
        self._quarantined: dict[str, float] = {}  # until when, monotonic seconds
        self._usual_s = 0.0  # what a frame takes at present

    async def track(self, request: TrackRequest, limits: Limits) -> TrackResult:
        """The answer of some worker to a frame, and of the first where one kept silent too long.

        Raises:
            UnavailableError: no worker answers.
            PointSlamError: what the worker raised.
        """
        start = time.monotonic()
        patience_s = max(self._config.patience_s, self._config.patience_ratio * self._usual_s)
        limits = replace(limits, patience_s=patience_s)
        result = await self._ask(Keys.track, request, TrackResult, limits)
        self._usual_s += _USUAL_STEP * (time.monotonic() - start - self._usual_s)
        return result

    async def localize(self, request: LocalizeRequest, limits: Limits) -> LocalizeResult:
        """The answer of some worker to a single image; see `track`."""
        return await self._ask(Keys.localize, request, LocalizeResult, limits)

    async def _ask(
        self,
        key_of: Callable[[str], str],
        request: TrackRequest | LocalizeRequest,
        kind: type,
        limits: Limits,
    ) -> Any:
        session, failed = limits.seat, set[str]()
        deadline = time.monotonic() + limits.wait_s
        race: Race[Any] = Race()
        try:
            while True:
                if not race.workers or self._healthy() - failed - race.workers:
                    worker = await self._pick(session, failed, race.workers, deadline)
                    limit_s = self._limit_s(session, worker, limits)
                    question = self._bus.question(key_of(worker), request, kind, limit_s)
                    race.enter(worker, question)
                    self._seats[session] = _Seat(worker, time.monotonic())
                for worker, answer in await race.ended(limits.patience_s):
                    if self._has_answered(session, worker, answer):
                        self._seats[session] = _Seat(worker, time.monotonic())
                        self._pass_over(session, race.silent(limits.patience_s))
                        return answer.result()
                    failed.add(worker)
        finally:
            race.close()

    def _limit_s(self, session: str, worker: str, limits: Limits) -> float:
        seat = self._seats.get(session)
        if seat is None or seat.worker != worker:
            return max(limits.timeout_s, self._config.first_frame_timeout_s)
        return limits.timeout_s

    def _has_answered(self, session: str, worker: str, answer: asyncio.Future[Any]) -> bool:
        """Whether a worker answered, if only to raise; one that did not loses its seat."""
        error = answer.exception()
        if isinstance(error, GoneError):
            RETRIES.labels("gone").inc()
            LOGGER.warning("tracking worker %s is gone; asked by %s", worker, session)
        elif isinstance(error, TimedOutError):
            self._pass_over(session, [worker])
        else:
            return True
        self._seats.pop(session, None)
        return False

    def _pass_over(self, session: str, workers: Iterable[str]) -> None:
        """Leave workers that did not answer in time alone for a while."""
        for worker in workers:
            LOGGER.warning("tracking worker %s keeps silent; asked by %s", worker, session)
            self._quarantined[worker] = time.monotonic() + self._config.quarantine_s
            RETRIES.labels("timeout").inc()
            QUARANTINES.inc()

    def count(self) -> int:
        """How many workers are alive."""
        return len(self._members.names)

    def release(self, session: str) -> None:
        """Forget a session."""
        self._seats.pop(session, None)

    async def _pick(
        self, session: str, failed: set[str], under_way: set[str], deadline: float
    ) -> str:
        while True:
            now = time.monotonic()
            # Where all are in quarantine, a slow answer is better than none.
            candidates = (self._healthy() or self._members.names) - failed - under_way
            if candidates:
                return self._seat(session, candidates, now)
            if now >= deadline:
                alive = len(self._members.names)
                raise UnavailableError(f"no tracking worker answers ({alive} of them alive)")
            # A worker that failed may be back (restarted under its name) or out of quarantine.
            await self._members.wait_for_change(min(0.25, deadline - now))
            failed.clear()

    def _healthy(self) -> set[str]:
        now = time.monotonic()
        return {w for w in self._members.names if self._quarantined.get(w, 0.0) <= now}

    def _seat(self, session: str, candidates: Set[str], now: float) -> str:
        seat = self._seats.get(session)
        if seat is not None and seat.worker in candidates:
            return seat.worker
        loads = dict.fromkeys(candidates, 0)
        for other, taken in self._seats.items():
            is_active = now - taken.used_s < self._config.idle_s
            if other != session and taken.worker in loads and is_active:
                loads[taken.worker] += 1
        return choose(session, loads, self._config.load_cap)
