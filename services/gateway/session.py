"""One session: its frames in order, its prior, its last poses, and the owner of its map."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import Callable
from typing import Any

from services.gateway.access.tenants import public_name
from services.gateway.delivery import Delivery
from services.gateway.errors import detail
from services.gateway.frame_queue import FrameQueue, Outcome
from services.gateway.frame_reply import reply_of
from services.gateway.live_view import LiveView
from services.gateway.localizer import Localizer
from services.gateway.owner import Fabric, MapOwner
from services.gateway.pose_feed import PoseFeed
from services.gateway.poses import TimedPose, record_of
from services.gateway.prior import next_prior, resumed_prior
from services.gateway.tracker_question import TrackerQuestion
from services.gateway.usage import Usage
from services.gateway.watcher import Watchers
from shared import codec
from shared.bus import Keys
from shared.errors import ClaimLostError, PointSlamError, UnavailableError
from shared.frames import Frame, Prior, TrackRequest
from shared.localization import LocalizeMessage, LocalizeReply
from shared.stream import FrameMessage, FrameReply
from shared.tracing import log_fields, span
from shared.tracks import Advance, Advanced, OpenReply

LOGGER = logging.getLogger(__name__)


class Session:
    """A session that this gateway serves; owned by the event loop."""

    def __init__(self, fabric: Fabric, opened: OpenReply) -> None:
        self.name = public_name(opened.session)
        self.calibration = opened.calibration
        self.created_ns = opened.created_ns
        self.is_live = opened.mode == "live"
        self.live = LiveView(opened.calibration.colour.intrinsics)
        self.owner = MapOwner(fabric, opened, self.live.events)
        self._fabric = fabric
        self._T_world_first = opened.T_world_first
        self._delivery = Delivery(self.owner, fabric.config.mapping)
        self.poses = PoseFeed(fabric.config.stream)
        room = fabric.config.limits.max_waiting_frames
        self._frames = FrameQueue(self._answer, self.is_live, room)
        self._question = TrackerQuestion(fabric, self.owner, self.is_live, opened.session)
        self._localizer = Localizer(fabric, self.owner, self.calibration)
        self.watchers = Watchers(fabric, self.owner, opened)
        self.usage = Usage()
        self._claim = 0  # the number of ours; 0 while another gateway may advance the session
        self._claiming = asyncio.Lock()
        self._stream: object = None  # the newest
        self._take_up(opened)
        self._unfollow = self._follow_owner()

    async def claim(self) -> None:
        """Make sure that this gateway is the one that advances the session.

        If another one was in between, what this one remembers is renewed.

        Raises:
            UnavailableError: the map has no owner who could say so.
        """
        async with self._claiming:
            wait_s = self._fabric.config.mapping.claim_wait_s if self._claim else None
            try:
                async with asyncio.timeout(wait_s):
                    reply = await self.owner.claim(self._claim)
            except (TimeoutError, UnavailableError):
                if self._claim == 0:
                    raise
                return  # nobody can claim it from an owner that is not there either
            if reply.opened is not None:
                self._lose_claim()
                self.owner.take(reply.opened)
                self._take_up(reply.opened)
            self._claim = reply.number

    def is_idle(self, idle_s: float) -> bool:
        """Whether nobody has used it for so long, and nothing is under way."""
        is_busy = self.poses.is_watched or self._delivery or not self._frames.is_empty
        return not is_busy and self.usage.idle_s > idle_s

    @property
    def undelivered(self) -> int:
        """Answered frames that the map's owner has not acknowledged."""
        return len(self._delivery)

    @property
    def frame_age_s(self) -> float:
        """Since when its oldest unanswered frame waits or is under way."""
        return self._frames.age_s

    async def begin_stream(self, stream: object) -> None:
        """Let one stream, and no older one, submit frames; raises as `claim`."""
        await self.claim()
        self._stream = stream

    def submit(self, message: FrameMessage, stream: object = None) -> asyncio.Future[Outcome]:
        """Queue a checked frame, of a stream or by itself; raises as `FrameQueue.submit`.

        Raises:
            ClaimLostError: a newer stream or another gateway advances the session.
        """
        self._require_claim()
        if stream not in (None, self._stream):
            raise _claim_lost(self.name)
        self.usage.touch()
        return self._frames.submit(message)

    async def track(self, message: FrameMessage) -> FrameReply:
        """Answer one checked frame; goes on to the end even if the caller does not wait.

        Raises:
            PointSlamError: the frame was refused.
        """
        try:
            return await self._track(message)
        except ClaimLostError:  # single frames may come by any gateway, one after the other
            return await self._track(message)

    async def _track(self, message: FrameMessage) -> FrameReply:
        if self._claim == 0:
            await self.claim()
        outcome = await asyncio.shield(self.submit(message))
        if isinstance(outcome, PointSlamError):
            raise outcome
        return outcome

    async def localize(self, message: LocalizeMessage) -> LocalizeReply:
        """Find a checked image in the map; no frame of the session waits for it.

        Raises:
            PointSlamError: the image was refused.
            UnavailableError: too many are under way.
        """
        return await self._localizer.localize(message, self.map_revision)

    @property
    def map_revision(self) -> int:
        """The revision to track in.

        Offline runs repeat exactly, so they use the one that the last reply told, never one heard
        by chance.
        """
        return self.owner.revision if self.is_live else self.owner.acknowledged_revision

    def pose(self, t_ns: int | None = None) -> TimedPose:
        """The newest pose, or the pose at a time.

        Raises:
            NotFoundError: there is none.
        """
        return self.poses.pose(self.owner.keyframes, t_ns)

    @property
    def prior(self) -> Prior | None:
        """What is known of the camera since the last frame with a pose; None before it."""
        return self._prior

    def state(self) -> dict[str, Any]:
        """The tracking side of the session as plain values."""
        prior = self._prior
        return {
            "last_seq": self.poses.newest[0],
            "last_t_ns": self.poses.newest[1],
            "lost_frames": prior.lost_frames if prior else 0,
            "newest_keyframe_seq": prior.newest_keyframe_seq if prior else -1,
            "undelivered": self.undelivered,
            "watchers": len(self.watchers),
        }

    async def flush(self, timeout_s: float) -> bool:
        """Wait until the map's owner has acknowledged every answered frame."""
        await self._frames.finish()
        return await self._delivery.flush(timeout_s)

    def close(self) -> None:
        """Stop serving; the map stays with its owner."""
        self._frames.refuse(UnavailableError("the session was closed"))
        self.watchers.close()
        self._delivery.give_up()
        self._unfollow()
        self.owner.close()
        self._fabric.trackers.release(self.owner.session)

    async def _answer(self, message: FrameMessage, waited_ms: float) -> FrameReply:
        name = self.owner.session
        with (
            log_fields(session=name, epoch=self.owner.epoch, seq=message.seq),
            span("frame", message.traceparent, session=name, seq=message.seq),
        ):
            return await self._track_and_deliver(message, waited_ms)

    async def _track_and_deliver(self, message: FrameMessage, waited_ms: float) -> FrameReply:
        self._require_claim()
        start = time.perf_counter()
        frame = message.frame()
        result = await self._question.ask(lambda: self._request(frame))
        prior = next_prior(self._prior, frame, result)
        entry = Advance(
            record_of(result),
            frame if result.keyframe is not None else None,
            result.keyframe,
            claim=self._claim,
            prior=prior,
        )
        await self._deliver(entry)
        self._prior = prior
        self.poses.add(entry.record, result.map_revision, self.owner.keyframes)
        total_ms = 1e3 * (time.perf_counter() - start)
        reply = reply_of(result, {"queue": waited_ms, "gateway": total_ms})
        if self._delivery.holds_keyframe:
            reply = dataclasses.replace(reply, keyframe=False)  # it may be, but is not yet
        if (problem := self._delivery.problem) is not None:
            reply = dataclasses.replace(reply, map_problem=detail(problem))
        self.live.show(frame, reply)
        return reply

    def _take_up(self, opened: OpenReply) -> None:
        """Remember what the owner knows, and nothing else."""
        self._prior = resumed_prior(opened)
        self.poses.reset(opened.last, opened.map_revision)
        self._frames.resume(self.poses.newest)

    def _follow_owner(self) -> Callable[[], None]:
        """Hear of frames that other gateways' clients send, and of claims."""
        loop = asyncio.get_running_loop()

        def heard(news: Advanced) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._follow, news)

        key = Keys.advanced(self.owner.session)
        return self._fabric.bus.subscribe(key, Advanced, heard, self._is_of_others)

    def _is_of_others(self, data: bytes) -> bool:
        """Whether an `Advanced` is not about our own frames, looked at before it is read."""
        return self._claim == 0 or codec.unpack_fields(data, ("claim",)) != {"claim": self._claim}

    def _follow(self, news: Advanced) -> None:
        if news.claim > self._claim > 0:
            self._lose_claim()
        if self._claim == 0 and news.record is not None:
            self.poses.add(news.record, news.map_revision, self.owner.keyframes)
            self.live.events.hear(news.record.seq, news.record.status)

    def _lose_claim(self) -> None:
        if self._claim > 0:
            LOGGER.info("%s: advanced by another gateway now", self.name)
        self._claim = 0
        self._frames.refuse(_claim_lost(self.name))
        self._delivery.give_up()

    def _require_claim(self) -> None:
        if self._claim == 0:
            raise _claim_lost(self.name)

    def _request(self, frame: Frame) -> TrackRequest:
        if self._delivery.holds_keyframe:
            # It would cover what a keyframe that trackers cannot see yet covers already.
            frame = dataclasses.replace(frame, may_be_keyframe=False)
        return TrackRequest(
            session=self.owner.session,
            epoch=self.owner.epoch,
            map_revision=self.map_revision,
            calibration=self.calibration,
            frame=frame,
            prior=self._prior,
            T_world_first=self._T_world_first,
            accepts_older_map=self.is_live,
        )

    async def _deliver(self, entry: Advance) -> None:
        try:
            await self._hand_over(entry)
        except ClaimLostError:
            self._claim = 0
            raise

    async def _hand_over(self, entry: Advance) -> None:
        if not self.is_live:
            await self.owner.advance(entry)
            return
        await self._delivery.put(entry)
        if entry.keyframe is not None:
            # Trackers ask for the neighbourhood of this keyframe with the next frame.
            await self._delivery.settle()


def _claim_lost(session: str) -> ClaimLostError:
    return ClaimLostError(f"another client advances session {session}: reconnect, or watch it")
