"""All sessions of one mapper, and the keys that it answers on the bus."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch

from services.mapping.config import MappingConfig
from services.mapping.priority import give_way
from services.mapping.sessions.opening import check_same, new_record
from services.mapping.sessions.served import Served, answers, withdraw
from services.mapping.sessions.session import Session
from services.mapping.sessions.surroundings import Surroundings
from services.mapping.storage.folders import (
    SessionFolder,
    check_session_name,
    has_session,
    read_record,
    remove_session,
    storage_errors,
)
from services.mapping.storage.georeference import georeference_answer
from services.mapping.storage.janitor import Janitor
from services.mapping.storage.leases import open_lease_store
from services.mapping.storage.log import count_keyframes
from services.mapping.storage.retention import is_pinned, overdue, set_pinned, stored_session
from services.mapping.storage.tenure import Lease, Tenure
from shared.bus import Bus, Keys
from shared.errors import NotFoundError, StorageError, UnavailableError
from shared.maps import (
    DeleteRequest,
    Empty,
    MapInfo,
    PinRequest,
    SessionList,
    SessionSummary,
)
from shared.tracks import (
    OpenReply,
    OpenRequest,
)

LOGGER = logging.getLogger(__name__)
_QUERY_THREADS = 8
_SLOW_THREADS = {"render": 2, "keyframe": 1, "export": 2, "save": 2}  # contexts never wait for them


@dataclass(frozen=True)
class MapperSettings:
    """Who this mapper is and where it works."""

    name: str
    data: Path
    config: MappingConfig
    device: torch.device


class MapperHost:
    """Opens, lists and deletes sessions, and serves those that are open."""

    def __init__(self, bus: Bus, settings: MapperSettings) -> None:
        self._bus = bus
        self._settings = settings
        self._lock = threading.Lock()
        self._is_closing = False
        self._served: dict[str, Served] = {}
        self._queries = ThreadPoolExecutor(_QUERY_THREADS, thread_name_prefix="query")
        lower = (give_way, (settings.config.owner.niceness,))
        self._slow = {
            question: ThreadPoolExecutor(threads, question, *lower)
            for question, threads in _SLOW_THREADS.items()
        }
        owner = settings.config.owner
        store = open_lease_store(owner.lease_store, settings.data)
        self._tenure = Tenure(store, settings.name, owner.lease_s, self._lost)
        tidying = (self._put_away_idle, self._delete_overdue)
        self._janitor = Janitor(min(owner.session_idle_s / 4, 15.0), tidying)
        with storage_errors(str(settings.data)):
            settings.data.mkdir(parents=True, exist_ok=True)

    def start(self) -> None:
        """Answer the mapper's own keys and be seen."""
        name = self._settings.name
        for question, kind, answer in (
            ("open", OpenRequest, self.open),
            ("list", Empty, lambda _: self.list()),
            ("delete", DeleteRequest, self.delete),
            ("pin", PinRequest, self.pin),
        ):
            self._bus.serve(Keys.mapper(name, question), kind, answer, self._queries)
        self._bus.declare_alive("mapping", name)
        self._janitor.start()

    def open(self, request: OpenRequest) -> OpenReply:
        """Create a session, take one up from disk, or name the one that is open.

        Raises:
            InputError: the name, mode or calibration cannot be used.
            NotFoundError: no such session, and no calibration to create it with.
            ConflictError: the session exists with other settings, or another mapper owns it.
            UnavailableError: this mapper has its fill of sessions.
            StorageError: the disk or the lease store refused, or the log is damaged.
        """
        check_session_name(request.session)
        with self._lock:
            if request.session not in self._served:
                self._served[request.session] = self._serve(request)
            elif request.calibration is not None:
                check_same(self._served[request.session].session.record, request)
            return self._served[request.session].session.opening()

    def list(self) -> SessionList:
        """All sessions on this mapper's disk that can be read; waits for none that is opened."""
        with storage_errors(str(self._settings.data)):
            folders = sorted(p for p in self._settings.data.iterdir() if has_session(p))
        summaries = [self._summary(folder) for folder in folders]
        return SessionList(tuple(s for s in summaries if s is not None))

    def infos(self) -> list[MapInfo]:
        """The state of every open session's map."""
        return [each.session.info() for each in list(self._served.values())]

    def delete(self, request: DeleteRequest) -> Empty:
        """Close a session and remove every byte of it.

        Raises:
            NotFoundError: there is no such session.
            ConflictError: another mapper owns it.
        """
        path = self._folder_of(request.session)
        with self._lock:
            if (served := self._served.pop(request.session, None)) is not None:
                withdraw(served, is_saved=False)
            self._remove(path.name)
        return Empty()

    def pin(self, request: PinRequest) -> Empty:
        """Keep a session whatever the rule of retention says, or no longer.

        Raises:
            NotFoundError: there is no such session.
            StorageError: the disk refused.
        """
        set_pinned(self._folder_of(request.session), request.is_pinned)
        return Empty()

    def _folder_of(self, session: str) -> Path:
        check_session_name(session)
        path = self._settings.data / session
        if not has_session(path):
            raise NotFoundError(f"there is no session {session}")
        return path

    def close(self) -> None:
        """Withdraw every session, with a snapshot of each."""
        self._janitor.stop()
        self._is_closing = True
        with self._lock:
            for name in list(self._served):
                self._put_away(name)
        self._tenure.close()
        for executor in (self._queries, *self._slow.values()):
            executor.shutdown(wait=False, cancel_futures=True)

    def _put_away_idle(self) -> None:
        """Keep memory bounded: what nobody asks for goes to disk; opening it takes it up again."""
        idle_s = self._settings.config.owner.session_idle_s
        for name, served in list(self._served.items()):
            with self._lock:  # for one at a time: whoever opens another waits for one snapshot
                is_idle = time.monotonic() - served.used_s > idle_s
                is_here = self._served.get(name) is served
                if is_here and is_idle and not served.session.is_working:
                    self._put_away(name)
                    LOGGER.info("%s: idle, put away", name)

    def _delete_overdue(self) -> None:
        """Keep the disk bounded, if settings say so."""
        rule, data = self._settings.config.retention, self._settings.data
        if not rule.is_set:
            return
        folders = [path for path in data.iterdir() if has_session(path)]
        stored = [stored_session(path, self._tenure.is_leased(path.name)) for path in folders]
        for name in overdue(stored, rule, time.time()):
            with self._lock:
                if name not in self._served:  # nobody opened it meanwhile
                    self._remove(name)

    def _remove(self, name: str) -> None:
        """Remove every byte of a session that is not open; the caller holds the lock."""
        self._tenure.claim(name, above=0)
        remove_session(self._settings.data / name)
        self._tenure.forget(name)
        LOGGER.info("%s: deleted", name)

    def _put_away(self, name: str) -> None:
        """Save a session and let any mapper have it; the caller holds the lock."""
        withdraw(self._served.pop(name), is_saved=True)
        self._tenure.release(name)

    def _lost(self, name: str, epoch: int) -> None:
        """Another mapper took a session while this process was frozen or out of reach."""
        self._queries.submit(self._step_down, name, epoch)

    def _step_down(self, name: str, epoch: int) -> None:
        with self._lock:
            served = self._served.get(name)
            if served is not None and served.session.record.epoch == epoch:
                withdraw(self._served.pop(name), is_saved=False)

    def _claim(self, request: OpenRequest) -> tuple[SessionFolder, Lease]:
        """The session's folder and lease; a new session's folder is made when it is ours."""
        path = self._settings.data / request.session
        exists = has_session(path)
        record = read_record(path) if exists else new_record(request)
        if exists and request.calibration is not None:
            check_same(record, request)
        lease = self._tenure.claim(request.session, record.epoch)
        folder = SessionFolder(path)
        if not exists:
            folder.clear()
            folder.write_record(record)
        return folder, lease

    def _serve(self, request: OpenRequest) -> Served:
        settings = self._settings
        self._make_room()
        surroundings = Surroundings(
            settings.name, settings.config, settings.device, self._bus.publish
        )
        try:
            folder, lease = self._claim(request)
            session = Session(folder, lease, surroundings)
        except Exception:  # also a fault of ours: another mapper may manage
            self._tenure.release(request.session)
            raise
        served = Served(session, ThreadPoolExecutor(1, thread_name_prefix="advance"))
        record = session.record
        located = georeference_answer(folder, lease.check)
        for question, kind, answer in (*answers(session), located):
            executor = self._slow.get(question, self._queries)
            executor = served.advances if question == "advance" else executor
            key = Keys.session(record.session, record.epoch, question)
            served.stops.append(self._bus.serve(key, kind, served.noting_use(answer), executor))
        LOGGER.info(
            "%s: epoch %d, %d frames, %d keyframes",
            record.session,
            record.epoch,
            session.ledger.entries,
            session.ledger.num_keyframes,
        )
        return served

    def _make_room(self) -> None:
        """Put the session away that rests longest, where there is no room for one more.

        Raises:
            UnavailableError: all of them are in use, or this process is ending.
        """
        owner, name = self._settings.config.owner, self._settings.name
        if self._is_closing:
            raise UnavailableError(f"mapper {name} is ending")
        if len(self._served) < owner.max_sessions:
            return
        before_s = time.monotonic() - owner.yield_idle_s
        resting = [
            (served.used_s, session)
            for session, served in self._served.items()
            if served.used_s < before_s and not served.session.is_working
        ]
        if not resting:
            raise UnavailableError(f"mapper {name} has {len(self._served)} sessions in use")
        _, session = min(resting)
        self._put_away(session)
        LOGGER.info("%s: idle, put away to make room", session)

    def _summary(self, folder: Path) -> SessionSummary | None:
        """None for a damaged session, or one that is just deleted: it must not hide the others."""
        served = self._served.get(folder.name)
        try:
            with storage_errors(str(folder)):
                record = read_record(folder)
                logs = sorted(folder.glob("log-*.bin"))
                keyframes = sum(count_keyframes(p, record.log_ends.get(p.name)) for p in logs)
        except (NotFoundError, StorageError) as error:
            LOGGER.warning("not listed: %s", error)
            return None
        return SessionSummary(
            session=record.session,
            created_ns=record.created_ns,
            mode=record.mode,
            keyframes=served.session.ledger.num_keyframes if served else keyframes,
            is_open=served is not None,
            is_pinned=is_pinned(folder),
        )
