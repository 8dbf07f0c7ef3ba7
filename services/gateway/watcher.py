"""Clients that watch: their cameras are found and followed in a session's map, and leave no trace.

A watcher's frames never become keyframes and never reach the map's owner; its trajectory is its
client's own. It is lost until it is found among the keyframes, and a loop that is closed meanwhile
moves it along with the keyframe that it was found by.
"""

from __future__ import annotations

import asyncio
import dataclasses
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from services.gateway.frame_queue import FrameQueue, Outcome
from services.gateway.frame_reply import reply_of
from services.gateway.owner import Fabric, MapOwner
from services.gateway.prior import next_prior
from services.gateway.tracker_question import TrackerQuestion
from services.gateway.usage import Usage
from shared.camera import Calibration
from shared.errors import UnavailableError
from shared.frames import HAS_POSE, Frame, Prior, TrackRequest
from shared.stream import FrameMessage, FrameReply
from shared.tracing import log_fields, span
from shared.tracks import OpenReply


class Watcher:
    """One client that watches, from its first frame to its last; a `FrameSink`."""

    def __init__(self, question: TrackerQuestion, calibration: Calibration, usage: Usage) -> None:
        self.name = question.seat
        self.is_live = question.is_live
        self.usage = usage
        self.calibration = calibration  # of the client's device; the session's unless it says so
        self._question = question
        room = question.fabric.config.limits.max_waiting_frames
        self._frames = FrameQueue(self._answer, self.is_live, room)
        self._prior: Prior | None = None
        self._is_closed = False

    async def begin(self) -> None:
        """Nothing is to be claimed."""

    def submit(self, message: FrameMessage) -> asyncio.Future[Outcome]:
        """Queue a checked frame; raises as `FrameQueue.submit`."""
        if self._is_closed:
            raise _closed()
        return self._frames.submit(message)

    def close(self) -> None:
        """Answer no more frames."""
        self._is_closed = True
        self._frames.refuse(_closed())
        self._question.fabric.trackers.release(self.name)

    async def _answer(self, message: FrameMessage, waited_ms: float) -> FrameReply:
        owner = self._question.owner
        with (
            log_fields(session=owner.session, epoch=owner.epoch, seq=message.seq),
            span("watch", message.traceparent, session=owner.session, seq=message.seq),
        ):
            return await self._track(message, waited_ms)

    async def _track(self, message: FrameMessage, waited_ms: float) -> FrameReply:
        start = time.perf_counter()
        frame = dataclasses.replace(message.frame(), may_be_keyframe=False)
        result = await self._question.ask(lambda: self._request(frame))
        was_found = self._prior is not None or result.status in HAS_POSE
        self._prior = next_prior(self._prior, frame, result)
        total_ms = 1e3 * (time.perf_counter() - start)
        reply = reply_of(result, {"queue": waited_ms, "gateway": total_ms})
        return reply if was_found else dataclasses.replace(reply, T_map_camera=None)

    def _request(self, frame: Frame) -> TrackRequest:
        owner = self._question.owner
        return TrackRequest(
            session=owner.session,
            epoch=owner.epoch,
            map_revision=owner.revision,
            calibration=self.calibration,
            frame=frame,
            prior=self._prior,
            T_world_first=np.eye(4),  # a watcher begins no map
            accepts_older_map=self.is_live,
        )


class Watchers:
    """All that watch one session by this gateway."""

    def __init__(self, fabric: Fabric, owner: MapOwner, opened: OpenReply) -> None:
        self._fabric = fabric
        self._owner = owner
        self._calibration = opened.calibration
        self._is_live = opened.mode == "live"
        self._watching: set[Watcher] = set()

    def __len__(self) -> int:
        return len(self._watching)

    @contextmanager
    def joined(self, usage: Usage) -> Iterator[Watcher]:
        """One more while the block runs."""
        seat = f"{self._owner.session}/watcher-{uuid.uuid4().hex[:8]}"
        question = TrackerQuestion(self._fabric, self._owner, self._is_live, seat)
        watcher = Watcher(question, self._calibration, usage)
        self._watching.add(watcher)
        try:
            yield watcher
        finally:
            self._watching.discard(watcher)
            watcher.close()

    def close(self) -> None:
        """Answer none of them any more: the session is served here no longer."""
        for watcher in self._watching:
            watcher.close()


def _closed() -> UnavailableError:
    return UnavailableError("the session that was watched was closed")
