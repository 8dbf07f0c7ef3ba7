"""A sequence as a client's frames, and what came back."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pointslam.client import FrameOptions, Session
from pointslam.datasets.base import Sequence, is_held_out
from pointslam.progress import describe, open_bar
from shared.errors import PointSlamError
from shared.frames import TrackingStatus
from shared.stream import ErrorDetail, FrameMessage, FrameReply

_INFO_EVERY_S = 1.0
_OUTSIDE_WORKER = ("queue", "gateway", "total")


@dataclass(frozen=True)
class StreamOptions:
    """How to play a sequence."""

    num_frames: int
    holdout: int
    is_live: bool
    speed: float = 1.0  # live: times that of the recording


@dataclass(frozen=True)
class StreamResult:
    """All replies, and how long they took."""

    replies: tuple[FrameReply, ...]
    wall_s: float

    def count(self, status: TrackingStatus) -> int:
        """How many frames were answered so."""
        return sum(reply.status is status for reply in self.replies)

    def worker_ms(self) -> dict[int, float]:
        """Time of each frame inside the tracking worker, by seq."""
        return {r.seq: r.timings_ms["total"] for r in self.replies if "total" in r.timings_ms}

    def stages_ms(self) -> dict[str, float]:
        """Median of each stage over the frames that had it."""
        times: dict[str, list[float]] = {}
        for reply in self.replies:
            for name, milliseconds in reply.timings_ms.items():
                if name not in _OUTSIDE_WORKER:
                    times.setdefault(name, []).append(milliseconds)
        return {name: float(np.median(values)) for name, values in times.items()}


def stream_sequence(session: Session, sequence: Sequence, options: StreamOptions) -> StreamResult:
    """Send a new session all frames; frame i has seq i.

    Raises:
        SequenceError: a frame cannot be read.
        PointSlamError: a frame was refused.
    """
    start = time.monotonic()
    next_info = start
    replies = []
    frames = _messages(session, sequence, options)
    with open_bar("frames", "frame", options.num_frames) as bar:
        for reply in session.stream(frames):
            if reply.error is not None:
                raise _refused(sequence, reply.seq, reply.error)
            replies.append(reply)
            bar.update(1)
            if time.monotonic() >= next_info:
                state = describe(session.info(), str(reply.status))
                bar.set_postfix_str(state, refresh=False)
                next_info = time.monotonic() + _INFO_EVERY_S
    return StreamResult(tuple(replies), time.monotonic() - start)


def _refused(sequence: Sequence, index: int, error: ErrorDetail) -> PointSlamError:
    where = f"{sequence.name}, frame {index}, stamp {sequence.stamp(index)}"
    return PointSlamError(f"{where}: {error.field}: {error.reason}")


def _messages(
    session: Session, sequence: Sequence, options: StreamOptions
) -> Iterator[FrameMessage]:
    start = time.monotonic()
    for index in range(options.num_frames):
        frame = sequence.frame(index)
        if options.is_live:
            due_s = 1e-9 * (frame.t_ns - sequence.t_ns(0))
            time.sleep(max(0.0, start + due_s / options.speed - time.monotonic()))
        may_be_keyframe = not is_held_out(index, options.holdout)
        yield session.frame(frame.rgb, frame.depth, frame.t_ns, FrameOptions(may_be_keyframe))
