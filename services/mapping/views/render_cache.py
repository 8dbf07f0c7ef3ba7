"""Drawn views of a map, kept for those who ask for the same view again.

What is kept is given again
* for as long as the map is as it was when it was drawn: the same revision, the same iterations;
* while the map is optimised, for at most `max_iterations` iterations and `max_age_s` seconds.
A keyframe or a correction, a new revision, ends both at once.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import NamedTuple

from services.mapping.config import RenderConfig
from shared.maps import RenderReply

_KEY_BYTES = 1024  # what an entry weighs beside its images


class Moment(NamedTuple):
    """Which map it was: every change of what is drawn changes one of the two."""

    revision: int  # keyframes and corrections
    iterations: int  # steps of optimisation


@dataclass(frozen=True)
class _Kept:
    reply: RenderReply
    moment: Moment
    drawn_s: float

    @property
    def num_bytes(self) -> int:
        reply = self.reply
        images = (reply.rgb, reply.depth_m, reply.alpha, reply.confidence)
        return _KEY_BYTES + sum(image.nbytes for image in images)


class RenderCache:
    """Views by what was asked for; those asked for longest ago go when there is no room."""

    def __init__(self, config: RenderConfig) -> None:
        self._config = config
        self._lock = threading.Lock()
        self._kept: OrderedDict[bytes, _Kept] = OrderedDict()
        self._num_bytes = 0

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: bytes, now: Moment, now_s: float) -> RenderReply | None:
        """The view that was drawn for `key`, unless it is out of date; `now_s` is monotonic."""
        with self._lock:
            kept = self._kept.get(key)
            if kept is None:
                return None
            if not self._is_fresh(kept, now, now_s):
                self._drop(key)
                return None
            self._kept.move_to_end(key)
            return kept.reply

    def put(self, key: bytes, reply: RenderReply, moment: Moment, now_s: float) -> None:
        """Keep a view that shows the map at `moment`; one larger than all the room is not kept."""
        kept = _Kept(reply, moment, now_s)
        with self._lock:
            if key in self._kept:
                self._drop(key)
            self._kept[key] = kept
            self._num_bytes += kept.num_bytes
            while self._num_bytes > self._config.cache_mb * 1_000_000:
                self._drop(next(iter(self._kept)))

    def _is_fresh(self, kept: _Kept, now: Moment, now_s: float) -> bool:
        if kept.moment == now:
            return True
        age = now.iterations - kept.moment.iterations
        is_recent = now_s - kept.drawn_s <= self._config.max_age_s
        is_near = 0 <= age <= self._config.max_iterations
        return kept.moment.revision == now.revision and is_near and is_recent

    def _drop(self, key: bytes) -> None:
        self._num_bytes -= self._kept.pop(key).num_bytes
