"""Renders of one session's map for whoever asks, beside its optimisation."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np

from services.mapping.config import RenderConfig
from services.mapping.pipeline import Mapper
from services.mapping.views.render_cache import Moment, RenderCache
from shared import codec
from shared.maps import RenderReply, RenderRequest


class Renders:
    """Answers render requests from any thread.

    Views are drawn one at a time, since one takes all cores; who asks for what is just being
    drawn for another finds it in the cache.
    """

    def __init__(self, mapper: Mapper, epoch: int, config: RenderConfig) -> None:
        self._mapper = mapper
        self._epoch = epoch
        self._cache = RenderCache(config)
        self._drawing = threading.Lock()

    def answer(self, request: RenderRequest) -> RenderReply:
        """The view, or no images where the asker has those of `request.unless_state` already.

        Waits while a step of the optimisation writes its results, never for a whole one.
        """
        asked = replace(request, unless_state="")
        key = codec.pack(asked)
        if request.unless_state == self._state(self._mapper.moment):
            return _unchanged(self._mapper.moment, request.unless_state)
        reply = self._kept(key)
        if reply is None:
            with self._drawing:
                reply = self._kept(key) or self._drawn(key, asked)
        if request.unless_state == reply.state:
            return _unchanged(Moment(reply.revision, 0), reply.state)
        return reply

    def _kept(self, key: bytes) -> RenderReply | None:
        return self._cache.get(key, self._mapper.moment, time.monotonic())

    def _drawn(self, key: bytes, request: RenderRequest) -> RenderReply:
        start_s = time.monotonic()
        moment, reply = self._mapper.render_at(request)
        reply = replace(reply, state=self._state(moment))
        self._cache.put(key, reply, moment, start_s)
        return reply

    def _state(self, moment: Moment) -> str:
        return f"{self._epoch}.{moment.revision}.{moment.iterations}"


def _unchanged(moment: Moment, state: str) -> RenderReply:
    nothing = np.zeros((0, 0), np.uint8)
    rgb, depth_m = np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32)
    return RenderReply(moment.revision, rgb, depth_m, nothing, nothing, state)
