"""One session: its frames in order, its prior, its last poses, and the owner of its map."""

from __future__ import annotations

import asyncio
import dataclasses
import time
from typing import Any

from services.gateway.access.tenants import public_name
from services.gateway.delivery import Delivery
from services.gateway.dispatch import Limits
from services.gateway.errors import detail
from services.gateway.frame_queue import FrameQueue, Outcome
from services.gateway.localizer import Localizer
from services.gateway.owner import Fabric, MapOwner
from services.gateway.poses import PoseRing, TimedPose, deviations, record_of
from services.gateway.prior import next_prior, resumed_prior
from shared.errors import PointSlamError
from shared.frames import HAS_POSE, Frame, TrackRequest
from shared.localization import LocalizeMessage, LocalizeReply
from shared.se3 import Pose
from shared.stream import FrameMessage, FrameReply
from shared.tracks import Advance, OpenReply, TrackResult


class Session:
    """A session that this gateway serves; owned by the event loop."""

    def __init__(self, fabric: Fabric, opened: OpenReply) -> None:
        self.name = public_name(opened.session)
        self.calibration = opened.calibration
        self.created_ns = opened.created_ns
        self.is_live = opened.mode == "live"
        self.owner = MapOwner(fabric, opened)
        self._fabric = fabric
        self._T_world_first = opened.T_world_first
        self._prior = resumed_prior(opened)
        self._delivery = Delivery(self.owner, fabric.config.mapping)
        stream = fabric.config.stream
        self._poses = PoseRing(stream.poses, stream.max_gap_s)
        newest = (-1, -1)
        if opened.last is not None:
            newest = (opened.last.seq, opened.last.t_ns)
            self._poses.add(opened.last, opened.map_revision)
        waiting = fabric.config.limits.max_waiting_frames
        self._frames = FrameQueue(self._answer, self.is_live, waiting, newest)
        self._newest = newest
        self._localizer = Localizer(fabric, self.owner, self.calibration)
        self._watchers: set[asyncio.Queue[TimedPose]] = set()

    def submit(self, message: FrameMessage) -> asyncio.Future[Outcome]:
        """Queue a checked frame; see `FrameQueue.submit` for what it raises."""
        return self._frames.submit(message)

    async def track(self, message: FrameMessage) -> FrameReply:
        """Answer one checked frame; goes on to the end even if the caller does not wait.

        Raises:
            PointSlamError: the frame was refused.
        """
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
        if t_ns is None:
            return self._poses.last(self.owner.keyframes)
        return self._poses.at(t_ns, self.owner.keyframes)

    def watch(self) -> asyncio.Queue[TimedPose]:
        """A queue that receives each new pose; a slow reader loses the oldest."""
        queue: asyncio.Queue[TimedPose] = asyncio.Queue(maxsize=4)
        self._watchers.add(queue)
        return queue

    def unwatch(self, queue: asyncio.Queue[TimedPose]) -> None:
        """Stop a queue of `watch`."""
        self._watchers.discard(queue)

    def state(self) -> dict[str, Any]:
        """The tracking side of the session as plain values."""
        seq, t_ns = self._newest
        prior = self._prior
        return {
            "last_seq": seq,
            "last_t_ns": t_ns,
            "lost_frames": prior.lost_frames if prior else 0,
            "newest_keyframe_seq": prior.newest_keyframe_seq if prior else -1,
            "undelivered": len(self._delivery),
        }

    async def flush(self, timeout_s: float) -> bool:
        """Wait until the map's owner has acknowledged every answered frame."""
        await self._frames.finish()
        return await self._delivery.flush(timeout_s)

    def close(self) -> None:
        """Stop serving; the map stays with its owner."""
        self._frames.close()
        self._delivery.close()
        self.owner.close()
        self._fabric.trackers.release(self.owner.session)

    async def _answer(self, message: FrameMessage, waited_ms: float) -> FrameReply:
        start = time.perf_counter()
        frame = message.frame()
        result = await self._ask_tracker(frame)
        entry = Advance(
            record_of(result), frame if result.keyframe is not None else None, result.keyframe
        )
        await self._deliver(entry)
        self._prior = next_prior(self._prior, frame, result)
        self._newest = (frame.seq, frame.t_ns)
        self._poses.add(entry.record, result.map_revision)
        self._tell_watchers()
        total_ms = 1e3 * (time.perf_counter() - start)
        reply = _reply(result, {"queue": waited_ms, "gateway": total_ms})
        problem = self._delivery.problem
        return reply if problem is None else dataclasses.replace(reply, map_problem=detail(problem))

    async def _ask_tracker(self, frame: Frame) -> TrackResult:
        dispatch = self._fabric.config.dispatch
        limits = Limits(dispatch.offline_timeout_s, dispatch.offline_wait_s)
        if self.is_live:
            limits = Limits(dispatch.live_timeout_s, dispatch.live_wait_s)

        async def ask() -> TrackResult:
            return await self._fabric.trackers.track(self._request(frame), limits)

        return await self.owner.ask_tracker(ask, limits.wait_s)

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
        if not self.is_live:
            await self.owner.advance(entry)
            return
        await self._delivery.put(entry)
        if entry.keyframe is not None:
            # Trackers ask for the neighbourhood of this keyframe with the next frame.
            await self._delivery.settle(self._fabric.config.mapping.keyframe_wait_s)

    def _tell_watchers(self) -> None:
        for queue in self._watchers:
            if queue.full():
                queue.get_nowait()
            queue.put_nowait(self.pose())


def _reply(result: TrackResult, times_ms: dict[str, float]) -> FrameReply:
    deviation = deviations(result.covariance) if result.status in HAS_POSE else None
    return FrameReply(
        seq=result.seq,
        t_ns=result.t_ns,
        status=result.status,
        T_map_camera=Pose.from_matrix(result.T_world_camera),
        pos_std_m=deviation[0] if deviation else None,
        rot_std_deg=deviation[1] if deviation else None,
        inliers=result.inliers,
        inlier_share=result.inlier_share,
        reference_seq=result.reference_seq,
        map_revision=result.map_revision,
        keyframe=result.keyframe is not None,
        timings_ms=result.timings_ms | times_ms,
    )
