"""A frame stream that goes on at another gateway when the one that it went to is gone."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from pointslam.client.calls import TrajectoryRecord
from shared.errors import UnavailableError
from shared.frames import HAS_POSE, TrackingStatus
from shared.se3 import Pose
from shared.stream import FrameMessage, FrameReply


@dataclass(frozen=True)
class Route:
    """How frames reach a system of several gateways."""

    stream: Callable[[Iterable[FrameMessage]], Iterator[FrameReply]]  # by the gateway in use
    trajectory: Callable[[], list[TrajectoryRecord]]
    turn: Callable[[], None]  # to the next gateway
    gateways: int


def resuming(frames: Iterable[FrameMessage], route: Route) -> Iterator[FrameReply]:
    """Replies to all frames in order, each once.

    Raises:
        UnavailableError: no gateway answers any more.
    """
    source, unanswered = iter(frames), deque[FrameMessage]()
    failures = 0
    while True:
        try:
            if failures:
                yield from _answered_already(unanswered, route.trajectory())
            for reply in route.stream(_again_then_new(tuple(unanswered), source, unanswered)):
                failures = 0
                unanswered.popleft()
                yield reply
            return
        except UnavailableError:
            failures += 1
            if failures >= route.gateways:
                raise
            route.turn()


def _again_then_new(
    again: Iterable[FrameMessage], source: Iterator[FrameMessage], unanswered: deque[FrameMessage]
) -> Iterator[FrameMessage]:
    yield from again
    for frame in source:
        unanswered.append(frame)
        yield frame


def _answered_already(
    unanswered: deque[FrameMessage], trajectory: list[TrajectoryRecord]
) -> Iterator[FrameReply]:
    """Replies that were lost on their way: their frames are in the session already."""
    records = {record.seq: record for record in trajectory}
    newest = max(records, default=-1)
    while unanswered and unanswered[0].seq <= newest:
        frame = unanswered.popleft()
        yield _reply(frame, records.get(frame.seq))


def _reply(frame: FrameMessage, record: TrajectoryRecord | None) -> FrameReply:
    if record is None:
        return FrameReply(frame.seq, frame.t_ns, TrackingStatus.SUPERSEDED)
    has_pose = record.status in HAS_POSE
    return FrameReply(
        seq=frame.seq,
        t_ns=frame.t_ns,
        status=record.status,
        T_map_camera=Pose.from_matrix(record.T_map_camera_online) if has_pose else None,
        reference_seq=record.reference_seq,
        keyframe=record.keyframe,
    )
