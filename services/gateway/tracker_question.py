"""One frame's question to the tracking workers, asked again where the map's owner has changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from services.gateway.dispatch import Limits
from services.gateway.owner import Fabric, MapOwner
from shared.frames import TrackRequest
from shared.tracks import TrackResult


@dataclass(frozen=True)
class TrackerQuestion:
    """Who asks about frames in one map."""

    fabric: Fabric
    owner: MapOwner
    is_live: bool
    seat: str  # sticks to one worker

    async def ask(self, request: Callable[[], TrackRequest]) -> TrackResult:
        """The answer to the request as it is when it is sent: the map's epoch may change.

        Raises:
            UnavailableError: no worker, or no mapper, in time.
            PointSlamError: what the worker raised.
        """
        limits = self._limits()

        async def ask_once() -> TrackResult:
            return await self.fabric.trackers.track(request(), limits)

        return await self.owner.ask_tracker(ask_once, limits.wait_s)

    def _limits(self) -> Limits:
        times = self.fabric.config.dispatch
        if self.is_live:
            return Limits(times.live_timeout_s, times.live_wait_s, self.seat)
        return Limits(times.offline_timeout_s, times.offline_wait_s, self.seat)
