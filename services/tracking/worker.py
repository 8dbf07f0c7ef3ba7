"""A worker on the bus: fetches and caches contexts, answers frames. Its memory is only a cache.

Offline an answer never depends on what is cached. A live frame whose map has no owner at present is
tracked in the last neighbourhood that this worker had of its session.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from typing import Any

from services.tracking import metrics
from services.tracking.config import TrackingConfig
from services.tracking.local_map import LocalMap
from services.tracking.localization import localize
from services.tracking.pipeline import track
from shared.bus import Bus, Keys
from shared.errors import UnavailableError
from shared.frames import TrackRequest
from shared.localization import LocalizeRequest, LocalizeResult
from shared.tracing import log_fields
from shared.tracks import (
    Candidates,
    CandidatesRequest,
    ContextRequest,
    TrackingContext,
    TrackResult,
)

_FETCHES = 4  # contexts asked for at the same time
ContextKey = tuple[str, int, int, int, bool]  # session, epoch, revision, reference_seq, near only


class ContextCache:
    """The last few local maps, of all sessions; safe between threads."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._maps: OrderedDict[ContextKey, LocalMap] = OrderedDict()
        self._silent: set[str] = set()  # sessions whose owner did not answer in time

    def __len__(self) -> int:
        return len(self._maps)

    def get(self, key: ContextKey) -> LocalMap | None:
        """The map of a key, now the most recently used one."""
        with self._lock:
            if key in self._maps:
                self._maps.move_to_end(key)
            return self._maps.get(key)

    def newest(self, session: str, reference_seq: int) -> LocalMap | None:
        """The most recently used map of a session, of what is near to a keyframe in any way.

        If it can be, one that shows the keyframe: several cameras may be in one map. Never one from
        before the map began: in that, any frame would be the first.
        """
        with self._lock:
            keys = [k for k in reversed(self._maps) if k[0] == session and not k[4]]
            maps = [self._maps[k] for k in keys if self._maps[k].context.num_keyframes > 0]
        shown = (local for local in maps if _shows(local, reference_seq))
        return next(shown, maps[0] if maps else None)

    def put(self, key: ContextKey, local: LocalMap) -> None:
        """Keep a map; the least recently used one leaves when there are too many."""
        with self._lock:
            self._maps[key] = local
            self._maps.move_to_end(key)
            self._silent.discard(key[0])
            while len(self._maps) > self._limit:
                self._maps.popitem(last=False)

    def note_silence(self, session: str) -> None:
        """The owner of a session's map did not answer in time."""
        with self._lock:
            self._silent.add(session)

    def is_silent(self, session: str) -> bool:
        """Whether the owner has given no map since it did not answer in time."""
        return session in self._silent


def _shows(local: LocalMap, seq: int) -> bool:
    """Whether a keyframe is one of a neighbourhood's."""
    context = local.context
    return seq == context.reference_seq or seq in (keyframe.seq for keyframe in context.window)


class BusSource:
    """The owner of one session's map, asked over the bus."""

    def __init__(
        self,
        bus: Bus,
        request: TrackRequest | LocalizeRequest,
        cache: ContextCache,
        config: TrackingConfig,
    ) -> None:
        self._bus = bus
        self._request = request
        self._cache = cache
        self._config = config
        self._ahead: dict[tuple[int, bool], Future[LocalMap]] = {}  # by seq, near only

    def fetch_ahead(self, reference_seq: int, executor: Executor) -> None:
        """Ask for a neighbourhood now; it comes while the frame is decoded.

        Those of its loop candidates come after: the next keyframe will want them.
        """
        fetch = partial(copy_context().run, self._with_loop_maps)
        fetched = executor.submit(fetch, reference_seq, executor)
        self._ahead[reference_seq, False] = fetched

    def _with_loop_maps(self, reference_seq: int, executor: Executor) -> LocalMap:
        local = self._local_map(reference_seq)
        for seq in local.context.loop_seqs[: self._config.loop.max_candidates].tolist():
            self._ahead[seq, True] = executor.submit(self._local_map, seq, is_near_only=True)
        return local

    def local_map(self, reference_seq: int) -> LocalMap:
        """The neighbourhood of a keyframe, from the cache where it is there.

        An older one of the session where that will do and the owner is absent or keeps silent.
        """
        ahead = self._ahead.get((reference_seq, False))
        if ahead is None:
            return self._local_map(reference_seq)
        older = self._older_map()
        if older is None:
            return ahead.result()
        try:
            return ahead.result(self._patience_s())
        except (UnavailableError, TimeoutError):
            self._cache.note_silence(self._request.session)
            return older  # what comes late is there for the next frame

    def _patience_s(self) -> float:
        """For the owner of a live map; one frame waits for an owner that is gone, and no more."""
        is_silent = self._cache.is_silent(self._request.session)
        return 0.0 if is_silent else self._config.map_patience_s

    def _older_map(self) -> LocalMap | None:
        request = self._request
        if not (isinstance(request, TrackRequest) and request.accepts_older_map):
            return None
        return self._cache.newest(
            request.session, request.prior.reference_seq if request.prior else -1
        )

    def loop_map(self, seq: int) -> LocalMap | None:
        """The neighbourhood of a keyframe, of what is near to it in the graph only.

        None where an older map must do: then this keyframe closes no loop.
        """
        ahead = self._ahead.get((seq, True))
        has_older = self._older_map() is not None
        is_silent = has_older and self._cache.is_silent(self._request.session)
        try:
            if ahead is not None:
                return ahead.result(0.0 if is_silent else None)
            return None if is_silent else self._local_map(seq, is_near_only=True)
        except (UnavailableError, TimeoutError):
            if not has_older:
                raise
            return None

    def _local_map(self, reference_seq: int, is_near_only: bool = False) -> LocalMap:
        session, epoch = self._request.session, self._request.epoch
        asked = ContextRequest(self._request.map_revision, reference_seq, is_near_only)
        local = self._cache.get((session, epoch, asked.revision, reference_seq, is_near_only))
        if local is None:
            context: TrackingContext = self._ask("context", asked, TrackingContext)
            local = LocalMap(context, self._config.registration)
            local = local if is_near_only else local.built()  # few loop candidates are attempted
            # A live map may have moved on: then this is the answer for its revision only.
            key = (session, epoch, context.revision, reference_seq, is_near_only)
            self._cache.put(key, local)
        return local

    def candidates(self, request: CandidatesRequest) -> Candidates:
        """Keyframes that look like a frame; none where an older map must do."""
        try:
            return self._ask("candidates", request, Candidates)
        except UnavailableError:
            older = self._older_map()
            if older is None:
                raise
            return Candidates(older.context.revision, ())

    def _ask(self, question: str, message: object, kind: type) -> Any:
        key = Keys.session(self._request.session, self._request.epoch, question)
        return self._bus.query(key, message, kind, self._config.query_timeout_s)


class Worker:
    """Answers frames and single images of any session."""

    def __init__(self, bus: Bus, config: TrackingConfig) -> None:
        self._bus = bus
        self._config = config
        self._cache = ContextCache(config.context_cache)
        self._fetching = ThreadPoolExecutor(_FETCHES, thread_name_prefix="context")
        self._helpers = ThreadPoolExecutor(config.concurrent_frames, thread_name_prefix="helper")

    def answer(self, request: TrackRequest) -> TrackResult:
        """Track one frame.

        Raises:
            InputError: calibration or images cannot be used; names the field.
            UnavailableError: the map's owner does not answer.
        """
        request.calibration.check()
        source = BusSource(self._bus, request, self._cache, self._config)
        source.fetch_ahead(request.prior.reference_seq if request.prior else -1, self._fetching)
        about = {"session": request.session, "epoch": request.epoch, "seq": request.frame.seq}
        with log_fields(**about):
            result = track(request, source, self._config, self._helpers)
        metrics.count(result)
        return result

    def localize(self, request: LocalizeRequest) -> LocalizeResult:
        """Find one image in a session's map.

        Raises:
            InputError, UnavailableError: as `answer`.
        """
        request.calibration.check()
        source = BusSource(self._bus, request, self._cache, self._config)
        return localize(request, source, self._config, self._helpers)
