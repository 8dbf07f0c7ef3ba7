"""The pool of tracking workers: which one gets a session's frame, and what if it fails.

Sessions stick to a worker by rendezvous hashing, so that its caches stay warm, and a cap on the
load spreads them. A worker that is gone is left at once, one that times out is left alone for a
while; the frame goes to another. The answer does not depend on which worker gave it.
"""

from __future__ import annotations

import hashlib
import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from services.gateway.config import DispatchConfig
from services.gateway.members import Members
from services.gateway.metrics import QUARANTINES, RETRIES
from shared.bus import Bus, Keys
from shared.errors import GoneError, TimedOutError, UnavailableError
from shared.frames import TrackRequest
from shared.localization import LocalizeRequest, LocalizeResult
from shared.tracks import TrackResult

LOGGER = logging.getLogger(__name__)


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


class TrackerPool:
    """Asks one worker at a time for each session's frames and single images."""

    def __init__(self, bus: Bus, members: Members, config: DispatchConfig) -> None:
        self._bus = bus
        self._members = members
        self._config = config
        self._seats: dict[str, _Seat] = {}
        self._quarantined: dict[str, float] = {}  # until when, monotonic seconds

    async def track(self, request: TrackRequest, timeout_s: float, wait_s: float) -> TrackResult:
        """The answer of some worker to a frame; waits `wait_s` for one to be there.

        Raises:
            UnavailableError: no worker answers.
            PointSlamError: what the worker raised.
        """
        return await self._ask(Keys.track, request, TrackResult, (timeout_s, wait_s))

    async def localize(
        self, request: LocalizeRequest, timeout_s: float, wait_s: float
    ) -> LocalizeResult:
        """The answer of some worker to a single image; see `track`."""
        return await self._ask(Keys.localize, request, LocalizeResult, (timeout_s, wait_s))

    async def _ask(
        self,
        key_of: Callable[[str], str],
        request: TrackRequest | LocalizeRequest,
        kind: type,
        times_s: tuple[float, float],
    ) -> Any:
        timeout_s, wait_s = times_s
        failed: set[str] = set()
        deadline = time.monotonic() + wait_s
        while True:
            worker = await self._pick(request.session, failed, deadline)
            limit = timeout_s
            if self._is_new(request.session, worker):
                limit = max(timeout_s, self._config.first_frame_timeout_s)
            self._seats[request.session] = _Seat(worker, time.monotonic())
            try:
                return await self._bus.ask(key_of(worker), request, kind, limit)
            except GoneError:
                RETRIES.labels("gone").inc()
                LOGGER.warning("tracking worker %s is gone; asked by %s", worker, request.session)
            except TimedOutError:
                LOGGER.warning("tracking worker %s timed out after %.1f s", worker, limit)
                self._quarantined[worker] = time.monotonic() + self._config.quarantine_s
                RETRIES.labels("timeout").inc()
                QUARANTINES.inc()
            failed.add(worker)
            self._seats.pop(request.session, None)

    def count(self) -> int:
        """How many workers are alive."""
        return len(self._members.names)

    def release(self, session: str) -> None:
        """Forget a session."""
        self._seats.pop(session, None)

    async def _pick(self, session: str, failed: set[str], deadline: float) -> str:
        while True:
            now = time.monotonic()
            candidates = self._healthy(now) - failed
            if candidates:
                return self._seat(session, candidates, now)
            if now >= deadline:
                alive = len(self._members.names)
                raise UnavailableError(f"no tracking worker answers ({alive} of them alive)")
            # A worker that failed may be back (restarted under its name) or out of quarantine.
            await self._members.wait_for_change(min(0.25, deadline - now))
            failed.clear()

    def _healthy(self, now: float) -> set[str]:
        return {w for w in self._members.names if self._quarantined.get(w, 0.0) <= now}

    def _seat(self, session: str, candidates: set[str], now: float) -> str:
        seat = self._seats.get(session)
        if seat is not None and seat.worker in candidates:
            return seat.worker
        loads = dict.fromkeys(candidates, 0)
        for other, taken in self._seats.items():
            is_active = now - taken.used_s < self._config.idle_s
            if other != session and taken.worker in loads and is_active:
                loads[taken.worker] += 1
        return choose(session, loads, self._config.load_cap)

    def _is_new(self, session: str, worker: str) -> bool:
        seat = self._seats.get(session)
        return seat is None or seat.worker != worker
