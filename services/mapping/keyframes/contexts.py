"""Neighbourhoods of the map's present revision, each built once."""

from __future__ import annotations

from services.mapping.keyframes.store import KeyframeStore
from shared.tracks import ContextRequest, TrackingContext

_MAX_KEPT = 8  # those of two references and of their loop candidates; each is some MB


class Contexts:
    """What workers ask for between two keyframes, often the same. Not locked: as the store."""

    def __init__(self, store: KeyframeStore) -> None:
        self._store = store
        self._revision = -1
        self._built: dict[tuple[int, bool], TrackingContext] = {}

    def get(self, request: ContextRequest) -> TrackingContext:
        """The neighbourhood of a keyframe, in the revision that the map has now.

        Raises:
            NotFoundError: no such keyframe, where only what is near to it is asked for.
        """
        if self._revision != self._store.revision:
            self._built.clear()
            self._revision = self._store.revision
        key = (request.reference_seq, request.is_near_only)
        if key not in self._built:
            if len(self._built) >= _MAX_KEPT:
                self._built.clear()
            self._built[key] = self._build(request)
        return self._built[key]

    def _build(self, request: ContextRequest) -> TrackingContext:
        if request.is_near_only:
            return self._store.loop_context(request.reference_seq)
        return self._store.context(request.reference_seq)
