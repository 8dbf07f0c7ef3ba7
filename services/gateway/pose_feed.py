"""The poses of one session as they come, for who asks and for who watches."""

from __future__ import annotations

import asyncio

from services.gateway.config import StreamConfig
from services.gateway.poses import PoseRing, TimedPose
from shared.tracks import FrameRecord, KeyframePoses

_NOTHING = (-1, -1)


class PoseFeed:
    """The last answered frames, whichever gateway answered them."""

    def __init__(self, config: StreamConfig) -> None:
        self.newest = _NOTHING  # seq and t_ns
        self._ring = PoseRing(config.poses, config.max_gap_s)
        self._watchers: set[asyncio.Queue[TimedPose]] = set()

    @property
    def is_watched(self) -> bool:
        """Whether somebody watches."""
        return bool(self._watchers)

    def reset(self, last: FrameRecord | None, map_revision: int) -> None:
        """Begin anew behind a session's last frame."""
        self._ring.clear()
        self.newest = _NOTHING
        if last is not None:
            self.newest = (last.seq, last.t_ns)
            self._ring.add(last, map_revision)

    def add(self, record: FrameRecord, map_revision: int, keyframes: KeyframePoses) -> None:
        """Add the newest answered frame and tell the watchers."""
        self.newest = (record.seq, record.t_ns)
        self._ring.add(record, map_revision)
        for queue in self._watchers:
            if queue.full():
                queue.get_nowait()
            queue.put_nowait(self._ring.last(keyframes))

    def pose(self, keyframes: KeyframePoses, t_ns: int | None = None) -> TimedPose:
        """The newest pose, or the pose at a time.

        Raises:
            NotFoundError: there is none.
        """
        return self._ring.last(keyframes) if t_ns is None else self._ring.at(t_ns, keyframes)

    def watch(self) -> asyncio.Queue[TimedPose]:
        """A queue that receives each new pose; a slow reader loses the oldest."""
        queue: asyncio.Queue[TimedPose] = asyncio.Queue(maxsize=4)
        self._watchers.add(queue)
        return queue

    def unwatch(self, queue: asyncio.Queue[TimedPose]) -> None:
        """Stop a queue of `watch`."""
        self._watchers.discard(queue)
