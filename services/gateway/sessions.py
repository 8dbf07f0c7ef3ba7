"""All sessions that this gateway knows: create, find, list, delete."""

from __future__ import annotations

import asyncio
import time
import uuid
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakValueDictionary

from services.gateway.access.tenants import full_name, is_callers, public_name
from services.gateway.create_request import CreateRequest
from services.gateway.dispatch import choose
from services.gateway.metrics import QUEUE_AGE, SESSIONS, UNDELIVERED
from services.gateway.owner import Fabric, UnansweredError, open_existing, open_new
from services.gateway.session import Session
from shared import codec, heap
from shared.bus import Keys
from shared.errors import (
    ConflictError,
    GoneError,
    NotFoundError,
    PointSlamError,
    UnavailableError,
)
from shared.maps import DeleteRequest, Empty, MapInfo, PinRequest, SessionList
from shared.tracks import OpenReply, OpenRequest


@dataclass
class Sessions:
    """Sessions by full name; those of another time are found on the mappers' disks.

    Callers give and see their tenant's own names: sessions of others do not exist for them.
    """

    fabric: Fabric
    _open: dict[str, Session] = field(default_factory=dict)
    # One lock a name, for as long as somebody opens it: no session waits for another's map.
    _opening: WeakValueDictionary[str, asyncio.Lock] = field(default_factory=WeakValueDictionary)

    async def create(self, request: CreateRequest) -> Session:
        """A new session, on the mapper that has the fewest of ours and room for it.

        Raises:
            InputError: a field cannot be used.
            ConflictError: a session of that name exists.
            UnavailableError: no mapper takes it.
        """
        request.check()
        name = full_name(request.name or uuid.uuid4().hex)
        open_request = OpenRequest(
            session=name,
            mode=request.mode,
            seed=request.seed,
            calibration=request.calibration,
            T_world_first=request.T_world_first(),
        )
        async with self._lock_of(name):
            if name in self._open or await self._mapper_of(name) is not None:
                raise ConflictError(f"session {public_name(name)} exists")
            opened = await self._make(open_request)
            self._open[name] = session = Session(self.fabric, opened)
        return session

    async def get(self, name: str) -> Session:
        """An open session, or one taken up again from a mapper's disk.

        Raises:
            NotFoundError: there is no such session.
            UnavailableError: no mapper could take it up in time.
        """
        name = full_name(name)
        if name not in self._open:
            async with self._lock_of(name):
                if name not in self._open:
                    self._open[name] = Session(self.fabric, await self._resume(name))
        session = self._open[name]
        session.usage.touch()
        return session

    def measure(self) -> None:
        """Tell Prometheus of all sessions whenever it asks."""
        QUEUE_AGE.set_function(lambda: max((s.frame_age_s for s in self._all()), default=0.0))
        UNDELIVERED.set_function(lambda: sum(s.undelivered for s in self._all()))
        SESSIONS.set_function(lambda: len(self._open))

    def _all(self) -> tuple[Session, ...]:
        return tuple(self._open.values())

    async def forget_idle(self) -> None:
        """Keep memory level, for ever: what nobody uses is closed; `get` takes it up again."""
        idle_s = self.fabric.config.session_idle_s
        while True:
            await asyncio.sleep(min(idle_s / 4, 15.0))
            for name, session in list(self._open.items()):
                if session.is_idle(idle_s):
                    self._open.pop(name).close()
            await asyncio.to_thread(heap.trim)

    def drain(self) -> None:
        """Be ready no longer, and let nothing that is asked wait for a mapper: we are ending."""
        self.fabric.ending.set()

    @property
    def is_draining(self) -> bool:
        """Whether this process is ending."""
        return self.fabric.ending.is_set()

    def is_serving(self, session: Session) -> bool:
        """Whether a session that was got is still served here."""
        return self._open.get(session.owner.session) is session and not self.is_draining

    async def list(self) -> list[dict[str, Any]]:
        """Every session of the caller's tenant on the live mappers, newest first.

        `tracking` is of those that are served here, else None.
        """
        found: dict[str, dict[str, Any]] = {}
        for mapper in sorted(self.fabric.mappers.names):
            for summary in (await self._list_of(mapper)).sessions:
                name = public_name(summary.session)
                if is_callers(summary.session) and (name not in found or summary.is_open):
                    served = self._open.get(summary.session)
                    found[name] = codec.to_json(summary) | {
                        "session": name,
                        "mapper": mapper,
                        "tracking": served.live.pulse.state() if served else None,
                    }
        return sorted(found.values(), key=lambda row: -row["created_ns"])

    async def delete(self, name: str) -> None:
        """Remove a session and every byte of it.

        Raises:
            NotFoundError: there is no such session.
        """
        name = full_name(name)
        async with self._lock_of(name):  # who is about to open it is not left with a ghost
            session = self._open.get(name)
            mapper = session.owner.mapper if session else await self._mapper_of(name)
            if mapper is None:
                raise NotFoundError(f"no session {public_name(name)!r}")
            await self._delete_at(mapper, name)
            if session is not None and self._open.pop(name, None) is session:
                session.close()

    async def _delete_at(self, mapper: str, name: str) -> None:
        """Ask until somebody has answered: a mapper that was gone before may have done it."""
        mapping, was_unanswered = self.fabric.config.mapping, False
        deadline = time.monotonic() + mapping.reopen_wait_s
        while True:
            key = Keys.mapper(mapper, "delete")
            try:
                await self.fabric.bus.ask(
                    key, DeleteRequest(name), Empty, mapping.question_timeout_s
                )
                return
            except NotFoundError:
                if was_unanswered:
                    return
                raise
            except GoneError:
                if time.monotonic() > deadline:
                    raise
            was_unanswered = True
            await asyncio.sleep(mapping.retry_s)
            mapper = await self._mapper_of(name) or mapper

    async def pin(self, name: str, is_pinned: bool) -> None:
        """Keep a session whatever the mapper's rule of retention says, or no longer.

        Raises:
            NotFoundError: there is no such session.
        """
        name = full_name(name)
        mapper = await self._mapper_of(name)
        if mapper is None:
            raise NotFoundError(f"no session {public_name(name)!r}")
        timeout_s = self.fabric.config.mapping.question_timeout_s
        request = PinRequest(name, is_pinned)
        await self.fabric.bus.ask(Keys.mapper(mapper, "pin"), request, Empty, timeout_s)

    async def info(self, session: Session) -> dict[str, Any]:
        """The map's state with the tracking side's under `tracking`, as plain JSON values."""
        timeout_s = self.fabric.config.mapping.question_timeout_s
        info: MapInfo = await session.owner.ask("info", Empty(), MapInfo, timeout_s)
        credit = {"credit": self.fabric.config.stream.credit}
        tracking = session.state() | session.live.pulse.state() | credit
        own = {"session": session.name, "created_ns": session.created_ns, "tracking": tracking}
        return codec.to_json(info) | own

    def is_ready(self) -> bool:
        """Whether a new session could be created and tracked."""
        is_staffed = bool(self.fabric.mappers.names and self.fabric.trackers.count())
        return is_staffed and not self.is_draining

    async def close(self) -> None:
        """Let every session finish what it has in flight, then stop serving it."""
        drain_s = self.fabric.config.drain_s
        sessions = list(self._open.values())
        if sessions:
            await asyncio.wait(
                [asyncio.create_task(session.flush(drain_s)) for session in sessions],
                timeout=drain_s,
            )
        for session in sessions:
            session.close()
        self._open.clear()

    def _lock_of(self, name: str) -> asyncio.Lock:
        return self._opening.setdefault(name, asyncio.Lock())

    async def _make(self, request: OpenRequest) -> OpenReply:
        """A new map; or the one that a mapper made that was gone before it could say so."""
        try:
            return await open_new(self.fabric, request, self._mappers_for(request.session))
        except UnansweredError as error:
            try:
                return await self._resume(request.session)
            except NotFoundError:
                raise error from None

    async def _resume(self, name: str) -> OpenReply:
        """The session from disk; waits while the lease of an owner that is gone runs out."""
        mapping = self.fabric.config.mapping
        deadline = time.monotonic() + mapping.reopen_wait_s
        while True:
            mapper = await self._mapper_of(name)
            if mapper is None:
                raise NotFoundError(f"no session {public_name(name)!r}")
            try:
                return await open_existing(self.fabric, name, mapper)
            except UnavailableError:
                if time.monotonic() > deadline:
                    raise
            await asyncio.sleep(mapping.retry_s)

    def _mappers_for(self, name: str) -> list[str]:
        """The live mappers, the one chosen for a new session first, then by load."""
        loads = dict.fromkeys(sorted(self.fabric.mappers.names), 0)
        if not loads:
            raise UnavailableError("no mapper is alive")
        for session in self._open.values():
            if session.owner.mapper in loads:
                loads[session.owner.mapper] += 1
        chosen = choose(name, loads, self.fabric.config.dispatch.load_cap)
        return sorted(loads, key=lambda mapper: (mapper != chosen, loads[mapper]))

    async def _mapper_of(self, name: str) -> str | None:
        """The mapper that has the session open, or else one whose disk holds it."""
        found = None
        for mapper in sorted(self.fabric.mappers.names):
            for summary in (await self._list_of(mapper)).sessions:
                if summary.session == name and (found is None or summary.is_open):
                    found = mapper
        return found

    async def _list_of(self, mapper: str) -> SessionList:
        timeout_s = self.fabric.config.mapping.question_timeout_s
        key = Keys.mapper(mapper, "list")
        try:
            return await self.fabric.bus.ask(key, Empty(), SessionList, timeout_s)
        except PointSlamError:
            if mapper in self.fabric.mappers.names:
                raise
            return SessionList(())  # it went away while it was asked
