"""The owner of a session's map, found again when it is gone."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from services.gateway.config import GatewayConfig
from services.gateway.dispatch import TrackerPool
from services.gateway.events import EventKind, SessionEvents
from services.gateway.members import Members
from services.gateway.metrics import TAKEOVERS
from services.gateway.open_streams import OpenStreams
from shared.bus import Bus, Keys
from shared.errors import (
    ConflictError,
    GoneError,
    NotFoundError,
    PointSlamError,
    StorageError,
    TimedOutError,
    UnavailableError,
)
from shared.maps import Empty
from shared.tracks import (
    Advance,
    AdvanceReply,
    ClaimReply,
    ClaimRequest,
    KeyframePoses,
    OpenReply,
    OpenRequest,
)

LOGGER = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(frozen=True)
class Fabric:
    """What every session uses: the bus, the live processes, the settings, who we are."""

    bus: Bus
    trackers: TrackerPool
    mappers: Members
    config: GatewayConfig
    name: str = "gateway"
    ending: asyncio.Event = field(default_factory=asyncio.Event)  # nobody waits for a mapper now
    streams: OpenStreams = field(default_factory=OpenStreams)


class MapOwner:
    """One session's map: which mapper owns it, in which epoch, at which revision."""

    def __init__(self, fabric: Fabric, opened: OpenReply, events: SessionEvents) -> None:
        self.session = opened.session
        self._events = events
        self.mapper = opened.mapper
        self.epoch = opened.epoch
        self.acknowledged_revision = opened.map_revision
        self.logged_seq = opened.last.seq if opened.last else -1
        self.keyframes = opened.keyframe_poses
        self._fabric = fabric
        self._config = fabric.config.mapping
        self._reopening = asyncio.Lock()
        self.lost = asyncio.Event()  # set while nobody is known to own the map
        loop = asyncio.get_running_loop()

        def heard(poses: KeyframePoses) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._publish, poses)

        self.close = fabric.bus.subscribe(Keys.revisions(self.session), KeyframePoses, heard)

    @property
    def revision(self) -> int:
        """The newest revision heard of, by reply or publication."""
        return max(self.acknowledged_revision, self.keyframes.revision)

    async def advance(self, entry: Advance) -> None:
        """Log one answered frame; returns when the owner has acknowledged it.

        Raises:
            PointSlamError: the owner refused it, or there is none.
        """
        reply = await self.ask("advance", entry, AdvanceReply, self._config.advance_timeout_s)
        self.acknowledged_revision = max(self.acknowledged_revision, reply.map_revision)
        self.logged_seq = max(self.logged_seq, reply.acknowledged_seq)

    async def claim(self, held: int) -> ClaimReply:
        """Ask to be who advances the session; `held` is the number of our claim, 0 without one.

        Raises:
            UnavailableError: the map has no owner who could say so.
        """
        request = ClaimRequest(self._fabric.name, held)
        return await self.ask("claim", request, ClaimReply, self._config.question_timeout_s)

    async def ask(self, question: str, message: object, kind: type, timeout_s: float) -> Any:
        """Ask the owner; when it is gone, open the session on a live mapper and ask again.

        Raises:
            PointSlamError: what the owner raised.
            UnavailableError: no mapper took the session up in time.
        """
        deadline = time.monotonic() + self._config.reopen_wait_s
        while True:
            epoch = self.epoch
            try:
                reply = await self._fabric.bus.ask(
                    Keys.session(self.session, epoch, question), message, kind, timeout_s
                )
            except GoneError:
                if time.monotonic() > deadline:  # there, but unsure of its lease all the time
                    raise
                await self.reopen(epoch, deadline)
            except TimedOutError:
                if self.mapper in self._fabric.mappers.names:
                    raise
                await self.reopen(epoch, deadline)
            else:
                self.lost.clear()  # back by itself, after a reopening that took too long
                return reply

    async def ask_tracker(self, ask: Callable[[], Awaitable[T]], wait_s: float) -> T:
        """Ask a tracking worker, and again after opening a map whose owner it could not reach.

        Raises:
            PointSlamError: what the worker raised.
            UnavailableError: no worker, or no mapper, in `wait_s` seconds.
        """
        deadline = time.monotonic() + wait_s
        while True:
            epoch = self.epoch
            try:
                return await ask()
            except UnavailableError:
                # The worker could not reach the map's owner, or no worker is there at all.
                if time.monotonic() >= deadline:
                    raise
                await self.reopen(epoch, deadline)

    async def reopen(self, epoch: int, deadline: float) -> None:
        """Open the session on a live mapper, unless another call did so since `epoch`.

        Raises:
            UnavailableError: no mapper took it up before the deadline (monotonic seconds).
        """
        async with self._reopening:
            while self.epoch == epoch:
                self.lost.set()
                await asyncio.sleep(self._config.retry_s)
                if await self._is_back() or await self._open_anywhere():
                    self.lost.clear()
                    return
                if time.monotonic() > deadline or self._fabric.ending.is_set():
                    raise UnavailableError(f"no mapper has session {self.session} at present")

    async def _is_back(self) -> bool:
        """Whether the old owner only was out of sight (its router restarted)."""
        key = Keys.session(self.session, self.epoch, "keyframes")
        try:
            self.keyframes = await ask_keyframes(self._fabric, key)
        except UnavailableError:
            return False
        return True

    async def _open_anywhere(self) -> bool:
        try:
            opened = await open_existing(self._fabric, self.session, self.mapper)
        except UnavailableError as error:
            LOGGER.info("%s: %s", self.session, error)
            return False
        LOGGER.warning(
            "%s: map now owned by %s, epoch %d", self.session, opened.mapper, opened.epoch
        )
        TAKEOVERS.inc()
        self._events.add(EventKind.OWNER_CHANGED, mapper=opened.mapper, epoch=opened.epoch)
        self.take(opened)
        return True

    def take(self, opened: OpenReply) -> None:
        """What the owner says of the session holds from here on."""
        self.mapper = opened.mapper
        self.epoch = opened.epoch
        self.acknowledged_revision = opened.map_revision
        self.keyframes = opened.keyframe_poses
        if opened.last is not None:
            self.logged_seq = opened.last.seq

    def _publish(self, poses: KeyframePoses) -> None:
        if poses.revision < self.keyframes.revision:
            return
        if poses.loops > self.keyframes.loops:
            shift_m = largest_shift_m(self.keyframes, poses)
            self._events.add(EventKind.LOOP_CLOSED, loops=poses.loops, max_shift_m=shift_m)
        self.keyframes = poses


def largest_shift_m(old: KeyframePoses, new: KeyframePoses) -> float:
    """How far the keyframe moved that moved most, metres."""
    _, in_old, in_new = np.intersect1d(old.seqs, new.seqs, return_indices=True)
    moved = new.T_world_keyframes[in_new, :3, 3] - old.T_world_keyframes[in_old, :3, 3]
    return float(np.linalg.norm(moved, axis=1).max(initial=0.0))


class UnansweredError(UnavailableError):
    """A mapper that was asked for a session went silent: it may have it all the same."""


async def open_new(fabric: Fabric, request: OpenRequest, mappers: Sequence[str]) -> OpenReply:
    """Create a session on the first of the mappers that has room and is well.

    Raises:
        InputError, ConflictError: the request cannot be met anywhere.
        UnansweredError: nobody says that it has the session, and somebody did not answer.
        UnavailableError: no mapper could take it; says why.
    """
    return await _open_on_first(fabric, request, mappers, (UnavailableError, StorageError))


async def open_existing(fabric: Fabric, session: str, preferred: str) -> OpenReply:
    """Open a session from disk, on the preferred mapper if that can.

    Raises:
        UnavailableError: no mapper could take it now, such as while a lost owner's lease runs.
    """
    mappers = sorted(fabric.mappers.names, key=lambda name: (name != preferred, name))
    passed_over = (UnavailableError, StorageError, NotFoundError, ConflictError)
    # The mode of a session on disk is the disk's to say.
    return await _open_on_first(fabric, OpenRequest(session, "offline"), mappers, passed_over)


async def _open_on_first(
    fabric: Fabric,
    request: OpenRequest,
    mappers: Sequence[str],
    passed_over: tuple[type[PointSlamError], ...],
) -> OpenReply:
    refusals: dict[str, PointSlamError] = {}
    timeout_s = fabric.config.mapping.open_timeout_s
    for mapper in mappers:
        try:
            return await fabric.bus.ask(Keys.mapper(mapper, "open"), request, OpenReply, timeout_s)
        except (*passed_over, ConflictError) as error:
            refusals[mapper] = error
            # Behind one that kept silent, a conflict may be with that one's session.
            if not isinstance(error, passed_over) and not _is_one_silent(refusals):
                raise
    reasons = "; ".join(f"{mapper}: {error}" for mapper, error in refusals.items())
    kind = UnansweredError if _is_one_silent(refusals) else UnavailableError
    raise kind(f"no mapper takes session {request.session} ({reasons or 'none is alive'})")


def _is_one_silent(refusals: Mapping[str, PointSlamError]) -> bool:
    return any(isinstance(error, (GoneError, TimedOutError)) for error in refusals.values())


async def ask_keyframes(fabric: Fabric, key: str) -> KeyframePoses:
    """Present keyframe poses of a session."""
    timeout_s = fabric.config.mapping.probe_timeout_s
    return await fabric.bus.ask(key, Empty(), KeyframePoses, timeout_s)
