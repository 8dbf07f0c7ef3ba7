"""The zenoh fabric: queries with three outcomes, publications, liveliness.

Live data is published with small ring buffers and may be lost; what must arrive is a query with a
reply. Multicast scouting and shared memory are off: both were measured to do harm (stale mappings,
silent loss), and TCP on one machine has 40 times the throughput that we need.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any

import zenoh

from shared import codec, tracing
from shared.errors import ConfigError, GoneError, InputError, UnavailableError
from shared.fabric import BusConfig, RouterConfig, answers, client_config, router_config
from shared.keys import Keys
from shared.replies import answer_query, read_reply, settle

LOGGER = logging.getLogger(__name__)

_SEEN_WITHIN_S = 2.0
_REFUSALS = 2


def open_router(endpoint: str, config: RouterConfig | None = None) -> zenoh.Session:
    """A router in this process, listening on an endpoint besides those of its settings.

    Raises:
        ConfigError: a file of its settings cannot be read.
        UnavailableError: an endpoint cannot be listened on.
    """
    config = config or RouterConfig()
    listen = (*([endpoint] if endpoint else []), *config.listen)
    try:
        return zenoh.open(router_config(dataclasses.replace(config, listen=listen)))
    except zenoh.ZError as error:
        raise UnavailableError(f"router cannot listen on {', '.join(listen)}: {error}") from None


def open_bus(endpoints: list[str], config: BusConfig | None = None, wait_s: float = 20.0) -> Bus:
    """Connect to one of several routers, trying for `wait_s` seconds.

    Raises:
        ConfigError: a file with our credentials cannot be read.
        UnavailableError: no router answers at any of the endpoints, or it does not let us in.
    """
    config = config or BusConfig()
    settings = client_config(endpoints, config)
    deadline = time.monotonic() + wait_s
    refusals = 0
    while True:
        try:
            return Bus(zenoh.open(settings), endpoints, config)
        except zenoh.ZError as error:
            # zenoh has tried for seconds, and does not say why it was refused: once may be a
            # machine that stood still meanwhile.
            present = answers(endpoints)
            refusals += bool(present)
            if present and refusals == _REFUSALS:
                raise UnavailableError(_refused(present, config)) from None
            if time.monotonic() > deadline:
                raise UnavailableError(
                    f"no zenoh router at {', '.join(endpoints)}: {error}"
                ) from None
            time.sleep(0.2)


def _refused(present: list[str], config: BusConfig) -> str:
    return (
        f"{', '.join(present)} answers but does not let us in as {config.who()}: a wrong password "
        "or certificate, or no zenoh router at all"
    )


class Bus:
    """One process's connection to the fabric; a context manager."""

    def __init__(self, session: zenoh.Session, endpoints: list[str], config: BusConfig) -> None:
        self._session = session
        self._endpoints = endpoints
        self._config = config
        self._declared: list[Any] = []

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def withdraw(self) -> None:
        """Be alive and answer no longer; what is under way can still be answered."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._declared.clear()

    def close(self) -> None:
        """Withdraw everything declared and disconnect."""
        self.withdraw()
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
            attachment=tracing.outgoing() or None,
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            priority=Keys.priority(key),
            timeout=timeout_s,
        )
        for reply in replies:
            return read_reply(reply, key, kind)
        raise GoneError(f"nobody answers {key}")

    async def ask(self, key: str, message: object, kind: type, timeout_s: float) -> Any:
        """`query` for asyncio; the event loop never blocks."""
        return await self.question(key, message, kind, timeout_s)

    def question(
        self, key: str, message: object, kind: type, timeout_s: float
    ) -> asyncio.Future[Any]:
        """`ask` without a task: asked at once; the future brings what `ask` returns or raises."""
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[Any] = loop.create_future()
        replies: list[zenoh.Reply] = []

        def bring() -> None:
            if not answered.done():
                settle(answered, replies, key, kind)

        def wake() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(bring)

        def hear(reply: zenoh.Reply) -> None:
            replies.append(reply)
            wake()

        def end() -> None:
            if not replies:  # a busy loop is woken once
                wake()

        handler = _on_zenohs_thread(hear, end)
        self._session.get(
            key,
            handler,
            payload=codec.pack(message),
            attachment=tracing.outgoing() or None,
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            priority=Keys.priority(key),
            timeout=timeout_s,
        )
        return answered

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

        handler = handle if executor is None else _on_zenohs_thread(handle)
        queryable = self._session.declare_queryable(key, handler, complete=True)
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
            express=True,
            congestion_control=zenoh.CongestionControl.DROP,
        )

    def subscribe(
        self,
        key: str,
        kind: type,
        receive: Callable[[Any], None],
        is_news: Callable[[bytes], bool] = lambda _: True,
    ) -> Callable[[], None]:
        """Call `receive` with each message that `is_news`; returns a function that stops it.

        Both are called on zenoh's own thread: they must not wait.
        """

        def handle(sample: zenoh.Sample) -> None:
            data = sample.payload.to_bytes()
            if not is_news(data):
                return
            try:
                receive(codec.unpack(kind, data))
            except InputError as error:
                LOGGER.warning("%s: dropped a publication: %s", key, error)

        subscriber = self._session.declare_subscriber(key, _on_zenohs_thread(handle))
        self._declared.append(subscriber)

        def stop() -> None:
            if subscriber in self._declared:
                self._declared.remove(subscriber)
                subscriber.undeclare()

        return stop

    def declare_alive(self, role: str, name: str) -> None:
        """Hold a token that vanishes with this process.

        Raises:
            ConfigError: the router's access list does not let us be this role.
        """
        self._declared.append(self._session.liveliness().declare_token(Keys.alive(role, name)))
        if self._config.is_named:
            self._require_seen(role, name)

    def _require_seen(self, role: str, name: str) -> None:
        """Look from a second connection: a router denies in silence, and we hear ourselves."""
        deadline = time.monotonic() + _SEEN_WITHIN_S
        with open_bus(self._endpoints, self._config) as witness:
            while name not in witness.alive(role):
                if time.monotonic() > deadline:
                    who = self._config.who()
                    raise ConfigError(f"the router's access list lets {who} not be {role}")
                time.sleep(0.05)

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
        names = self.alive(role)
        if not any(name.startswith(prefix) for name in names):
            found = ", ".join(sorted(names)) or "none"
            raise UnavailableError(f"no {role} service named {prefix}* is alive; alive: {found}")

    def alive(self, role: str) -> set[str]:
        """Names of a role's processes, as the routers know them now."""
        replies = self._session.liveliness().get(Keys.alive(role, "*"), timeout=3.0)
        return {str(r.ok.key_expr).rsplit("/", 1)[-1] for r in replies if r.ok is not None}


def _on_zenohs_thread(
    hear: Callable[[Any], None], end: Callable[[], None] | None = None
) -> zenoh.handlers.Callback[Any]:
    """Called as it comes; a plain function would have a thread, and be kept alive by it."""
    return zenoh.handlers.Callback(hear, end, indirect=False)
