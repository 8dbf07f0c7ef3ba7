"""The zenoh fabric: keys, queries with three outcomes, publications, liveliness.

Live data is published with small ring buffers and may be lost; what must arrive is a query with a
reply. Multicast scouting and shared memory are off: both were measured to do harm (stale mappings,
silent loss), and TCP on one machine has 40 times the throughput that we need.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any

import zenoh

from shared import codec
from shared.errors import GoneError, InputError, UnavailableError
from shared.replies import answer_query, read_reply

LOGGER = logging.getLogger(__name__)

MAX_MESSAGE_BYTES = 256 << 20
_LEASE_MS = 2000
_ROOT = "ps/v1"


class Keys:
    """Every key expression of the system."""

    @staticmethod
    def track(worker: str) -> str:
        """Frames for one tracking worker (TrackRequest, TrackResult)."""
        return f"{_ROOT}/track/{worker}/frame"

    @staticmethod
    def localize(worker: str) -> str:
        """Single images for one tracking worker (LocalizeRequest, LocalizeResult)."""
        return f"{_ROOT}/track/{worker}/localize"

    @staticmethod
    def mapper(mapper: str, question: str) -> str:
        """Queries to one mapper.

        open (OpenRequest, OpenReply), list (Empty, SessionList), delete (DeleteRequest, Empty).
        """
        return f"{_ROOT}/mapper/{mapper}/{question}"

    @staticmethod
    def session(session: str, epoch: int, question: str) -> str:
        """Queries to the owner of a session's map in one epoch.

        advance (Advance, AdvanceReply), context (ContextRequest, TrackingContext),
        candidates (CandidatesRequest, Candidates), keyframes (Empty, KeyframePoses),
        render (RenderRequest, RenderReply), export (ExportRequest, ExportChunk),
        refine (RefineRequest, JobStatus), refinement (Empty, JobStatus), interrupt (Empty,
        JobStatus), save (SaveRequest, SaveReply), info (Empty, MapInfo),
        trajectory (TrajectoryRequest, Trajectory).
        """
        return f"{_ROOT}/session/{session}/{epoch}/{question}"

    @staticmethod
    def revisions(session: str) -> str:
        """Publications of KeyframePoses."""
        return f"{_ROOT}/revision/{session}"

    @staticmethod
    def alive(role: str, name: str) -> str:
        """Liveliness token of a process; role is tracking or mapping."""
        return f"{_ROOT}/alive/{role}/{name}"


def zenoh_config(mode: str, connect: list[str], listen: list[str]) -> zenoh.Config:
    """Our zenoh settings: no scouting, no shared memory, short leases, bounded messages."""
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/endpoints": connect,
        "connect/timeout_ms": 3000,
        "connect/retry": {"period_max_ms": 1000},
        "listen/endpoints": listen,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_router(endpoint: str) -> zenoh.Session:
    """A router in this process.

    Raises:
        UnavailableError: the endpoint cannot be listened on.
    """
    try:
        return zenoh.open(zenoh_config("router", [], [endpoint]))
    except zenoh.ZError as error:
        raise UnavailableError(f"router cannot listen on {endpoint}: {error}") from None


def open_bus(endpoints: list[str], wait_s: float = 20.0) -> Bus:
    """Connect to a router, trying for `wait_s` seconds.

    Raises:
        UnavailableError: no router answers at any of the endpoints.
    """
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return Bus(zenoh.open(zenoh_config("client", endpoints, [])))
        except zenoh.ZError as error:
            if time.monotonic() > deadline:
                raise UnavailableError(
                    f"no zenoh router at {', '.join(endpoints)}: {error}"
                ) from None
            time.sleep(0.2)


class Bus:
    """One process's connection to the fabric; a context manager."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._declared: list[Any] = []

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Withdraw everything declared and disconnect."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._declared.clear()
        self._session.close()

    def query(self, key: str, message: object, kind: type, timeout_s: float) -> Any:
        """Ask and wait for one reply of type `kind`.

        Raises:
            GoneError, TimedOutError: no reply.
            PointSlamError: what the other side raised, rebuilt here.
        """
        replies = self._session.get(
            key,
            payload=codec.pack(message),
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
        )
        for reply in replies:
            return read_reply(reply, key, kind)
        raise GoneError(f"nobody answers {key}")

    async def ask(self, key: str, message: object, kind: type, timeout_s: float) -> Any:
        """`query` for asyncio; the event loop never blocks."""
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[zenoh.Reply | None] = loop.create_future()

        def settle(reply: zenoh.Reply | None) -> None:
            if not answered.done():
                answered.set_result(reply)

        def put(reply: zenoh.Reply | None) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(settle, reply)

        # indirect=False: run on zenoh's own thread instead of one new thread a call.
        handler = zenoh.handlers.Callback(put, lambda: put(None), indirect=False)
        self._session.get(
            key,
            handler,
            payload=codec.pack(message),
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
        )
        if (reply := await answered) is None:
            raise GoneError(f"nobody answers {key}")
        return read_reply(reply, key, kind)

    def serve(
        self,
        key: str,
        kind: type,
        answer: Callable[[Any], object],
        executor: Executor | None = None,
    ) -> Callable[[], None]:
        """Answer queries on `key` with `answer(message)`, one at a time or on an executor.

        Returns a function that stops serving.
        """

        def handle(query: zenoh.Query) -> None:
            if executor is None:
                answer_query(query, key, kind, answer)
            else:
                executor.submit(answer_query, query, key, kind, answer)

        queryable = self._session.declare_queryable(key, handle, complete=True)
        self._declared.append(queryable)

        def stop() -> None:
            if queryable in self._declared:
                self._declared.remove(queryable)
                queryable.undeclare()

        return stop

    def publish(self, key: str, message: object) -> None:
        """Tell whoever listens; never blocks, may be lost."""
        self._session.put(
            key,
            codec.pack(message),
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.DROP,
        )

    def subscribe(self, key: str, kind: type, receive: Callable[[Any], None]) -> Callable[[], None]:
        """Call `receive` with each message; returns a function that stops it."""

        def handle(sample: zenoh.Sample) -> None:
            try:
                receive(codec.unpack(kind, sample.payload.to_bytes()))
            except InputError as error:
                LOGGER.warning("%s: dropped a publication: %s", key, error)

        subscriber = self._session.declare_subscriber(key, handle)
        self._declared.append(subscriber)

        def stop() -> None:
            if subscriber in self._declared:
                self._declared.remove(subscriber)
                subscriber.undeclare()

        return stop

    def declare_alive(self, role: str, name: str) -> None:
        """Hold a token that vanishes with this process."""
        self._declared.append(self._session.liveliness().declare_token(Keys.alive(role, name)))

    def watch_alive(self, role: str, changed: Callable[[str, bool], None]) -> None:
        """Call `changed(name, is_alive)` for each process of a role, present ones first."""

        def handle(sample: zenoh.Sample) -> None:
            name = str(sample.key_expr).rsplit("/", 1)[-1]
            changed(name, sample.kind == zenoh.SampleKind.PUT)

        subscriber = self._session.liveliness().declare_subscriber(
            Keys.alive(role, "*"), handle, history=True
        )
        self._declared.append(subscriber)

    def require_alive(self, role: str, prefix: str) -> None:
        """Look once for a process of a role whose name starts with `prefix`.

        Raises:
            UnavailableError: there is none; names those that there are.
        """
        replies = self._session.liveliness().get(Keys.alive(role, "*"), timeout=3.0)
        names = [str(r.ok.key_expr).rsplit("/", 1)[-1] for r in replies if r.ok is not None]
        if not any(name.startswith(prefix) for name in names):
            found = ", ".join(sorted(names)) or "none"
            raise UnavailableError(f"no {role} service named {prefix}* is alive; alive: {found}")
