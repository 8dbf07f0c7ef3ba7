"""All sessions of one mapper, and the keys that it answers on the bus."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from services.mapping.config import MappingConfig
from services.mapping.log import count_keyframes
from services.mapping.session import Session, Surroundings
from services.mapping.storage import (
    SessionFolder,
    SessionRecord,
    check_session_name,
    has_session,
    read_record,
    remove_session,
    storage_errors,
)
from services.mapping.worker import LIVE, OFFLINE
from shared import codec
from shared.bus import Bus, Keys
from shared.errors import (
    ConflictError,
    InputError,
    NotFoundError,
    PointSlamError,
    StorageError,
)
from shared.maps import (
    DeleteRequest,
    Empty,
    ExportRequest,
    RefineRequest,
    RenderRequest,
    SaveRequest,
    SessionList,
    SessionSummary,
    TrajectoryRequest,
)
from shared.tracks import (
    Advance,
    CandidatesRequest,
    ContextRequest,
    KeyframePoses,
    OpenReply,
    OpenRequest,
)

LOGGER = logging.getLogger(__name__)
_QUERY_THREADS = 8


@dataclass(frozen=True)
class MapperSettings:
    """Who this mapper is and where it works."""

    name: str
    data: Path
    config: MappingConfig
    device: torch.device


@dataclass
class _Served:
    """An open session and what must be undone to close it."""

    session: Session
    advances: ThreadPoolExecutor  # one thread: the entries of a session stay in order
    stops: list[Callable[[], None]] = field(default_factory=list)
    used_s: float = field(default_factory=time.monotonic)

    def noting_use(self, answer: Callable[[Any], object]) -> Callable[[Any], object]:
        """`answer`, noting that somebody asked."""

        def noted(request: Any) -> object:
            self.used_s = time.monotonic()
            return answer(request)

        return noted


class MapperHost:
    """Opens, lists and deletes sessions, and serves those that are open."""

    def __init__(self, bus: Bus, settings: MapperSettings) -> None:
        self._bus = bus
        self._settings = settings
        self._lock = threading.Lock()
        self._served: dict[str, _Served] = {}
        self._queries = ThreadPoolExecutor(_QUERY_THREADS, thread_name_prefix="query")
        self._is_closed = threading.Event()
        self._janitor = threading.Thread(target=self._put_away_idle, name="janitor", daemon=True)
        with storage_errors(str(settings.data)):
            settings.data.mkdir(parents=True, exist_ok=True)

    def start(self) -> None:
        """Answer the mapper's own keys and be seen."""
        name = self._settings.name
        for question, kind, answer in (
            ("open", OpenRequest, self.open),
            ("list", Empty, lambda _: self.list()),
            ("delete", DeleteRequest, self.delete),
        ):
            self._bus.serve(Keys.mapper(name, question), kind, answer, self._queries)
        self._bus.declare_alive("mapping", name)
        self._janitor.start()

    def open(self, request: OpenRequest) -> OpenReply:
        """Create a session, take one up from disk, or name the one that is open.

        Raises:
            InputError: the name, mode or calibration cannot be used.
            NotFoundError: no such session, and no calibration to create it with.
            ConflictError: the session exists with another calibration, or elsewhere.
            StorageError: the disk refused, or its log is damaged.
        """
        check_session_name(request.session)
        with self._lock:
            if request.session not in self._served:
                self._served[request.session] = self._serve(self._open_folder(request))
            elif request.calibration is not None:
                _check_same(self._served[request.session].session.record, request)
            return self._served[request.session].session.opening()

    def list(self) -> SessionList:
        """All sessions on this mapper's disk that can be read."""
        with self._lock, storage_errors(str(self._settings.data)):
            folders = sorted(p for p in self._settings.data.iterdir() if has_session(p))
            summaries = [self._summary(folder) for folder in folders]
        return SessionList(tuple(s for s in summaries if s is not None))

    def delete(self, request: DeleteRequest) -> Empty:
        """Close a session and remove every byte of it.

        Raises:
            NotFoundError: there is no such session.
        """
        check_session_name(request.session)
        path = self._settings.data / request.session
        with self._lock:
            if not has_session(path):
                raise NotFoundError(f"there is no session {request.session}")
            if (served := self._served.pop(request.session, None)) is not None:
                _withdraw(served, is_saved=False)
            remove_session(path)
        return Empty()

    def close(self) -> None:
        """Withdraw every session, with a snapshot of each."""
        self._is_closed.set()
        with self._lock:
            for served in self._served.values():
                _withdraw(served, is_saved=True)
            self._served.clear()
        self._queries.shutdown(wait=False, cancel_futures=True)

    def _put_away_idle(self) -> None:
        """Keep memory bounded: what nobody asks for goes to disk; opening it takes it up again."""
        idle_s = self._settings.config.owner.session_idle_s
        while not self._is_closed.wait(min(idle_s / 4, 15.0)):
            with self._lock:
                for name, served in list(self._served.items()):
                    is_idle = time.monotonic() - served.used_s > idle_s
                    if is_idle and not served.session.is_working:
                        _withdraw(self._served.pop(name), is_saved=True)
                        LOGGER.info("%s: idle, put away", name)

    def _open_folder(self, request: OpenRequest) -> SessionFolder:
        path = self._settings.data / request.session
        if has_session(path):
            if request.calibration is not None:
                _check_same(read_record(path), request)
            return SessionFolder(path)
        record = _new_record(request)
        folder = SessionFolder(path)
        folder.clear()
        folder.write_record(record)
        return folder

    def _serve(self, folder: SessionFolder) -> _Served:
        settings = self._settings
        surroundings = Surroundings(settings.name, settings.config, settings.device, self._publish)
        try:
            session = Session(folder, surroundings)
        except PointSlamError:
            folder.close()
            raise
        served = _Served(session, ThreadPoolExecutor(1, thread_name_prefix="advance"))
        record = session.record
        for question, kind, answer in _answers(session):
            executor = served.advances if question == "advance" else self._queries
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

    def _publish(self, session: str, poses: KeyframePoses) -> None:
        self._bus.publish(Keys.revisions(session), poses)

    def _summary(self, folder: Path) -> SessionSummary | None:
        """None for a damaged session: it must not hide the others."""
        served = self._served.get(folder.name)
        try:
            record = read_record(folder)
            keyframes = sum(count_keyframes(path) for path in folder.glob("log-*.bin"))
        except StorageError as error:
            LOGGER.warning("not listed: %s", error)
            return None
        return SessionSummary(
            session=record.session,
            created_ns=record.created_ns,
            mode=record.mode,
            keyframes=served.session.ledger.num_keyframes if served else keyframes,
            is_open=served is not None,
        )


def _answers(session: Session) -> list[tuple[str, type, Callable[[Any], object]]]:
    """The questions of `Keys.session`, with what they carry and who answers."""
    ledger = session.ledger
    return [
        ("advance", Advance, session.advance),
        ("context", ContextRequest, ledger.context),
        ("candidates", CandidatesRequest, ledger.candidates),
        ("keyframes", Empty, lambda _: ledger.poses()),
        ("render", RenderRequest, session.render),
        ("export", ExportRequest, session.export),
        ("refine", RefineRequest, session.refine),
        ("interrupt", Empty, lambda _: session.interrupt()),
        ("save", SaveRequest, lambda _: session.save()),
        ("info", Empty, lambda _: session.info()),
        ("trajectory", TrajectoryRequest, lambda _: ledger.trajectory()),
    ]


def _withdraw(served: _Served, is_saved: bool) -> None:
    for stop in served.stops:
        stop()
    served.advances.shutdown(wait=True, cancel_futures=True)  # none may find the log closed
    served.session.close(is_saved)


def _new_record(request: OpenRequest) -> SessionRecord:
    if request.calibration is None:
        raise NotFoundError(f"there is no session {request.session}")
    if request.mode not in (OFFLINE, LIVE):
        raise InputError("mode", f"must be {OFFLINE!r} or {LIVE!r}, got {request.mode[:40]!r}")
    request.calibration.check()
    return SessionRecord(
        session=request.session,
        mode=request.mode,
        seed=request.seed,
        epoch=0,
        created_ns=time.time_ns(),
        calibration=request.calibration,
        T_world_first=request.T_world_first,
    )


def _check_same(record: SessionRecord, request: OpenRequest) -> None:
    """Creating a session again is fine if it means the same: the sender lost the reply."""
    again = (request.mode, request.seed, codec.pack(request.calibration))
    if again != (record.mode, record.seed, codec.pack(record.calibration)):
        raise ConflictError(f"session {request.session} exists with other settings")
