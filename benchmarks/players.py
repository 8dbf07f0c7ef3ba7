"""Clients that play a recording at a fixed rate, reconnect when the gateway goes, and keep time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.cluster import wait_for
from benchmarks.disturbances import to_and_fro
from pointslam.client import Client, Session
from pointslam.datasets.base import Sequence
from shared.errors import PointSlamError, UnavailableError
from shared.frames import HAS_POSE, TrackingStatus
from shared.stream import FrameMessage, FrameReply


@dataclass(frozen=True)
class Play:
    """What a client plays: a recording to and fro, and how fast."""

    sequence: Sequence
    mode: str = "live"
    num_frames: int = 150
    rate_hz: float = 15.0
    holds_last: bool = False  # the last frame waits until the player may end

    def t_ns(self, seq: int) -> int:
        """The stamp of a frame."""
        return round(seq * 1e9 / self.rate_hz)


@dataclass
class Heard:
    """What a client was told, and when; times are monotonic seconds."""

    replies: dict[int, FrameReply] = field(default_factory=dict)
    sent_s: dict[int, float] = field(default_factory=dict)
    at_s: dict[int, float] = field(default_factory=dict)
    breaks: int = 0  # of its connection

    def add(self, reply: FrameReply) -> None:
        """Note one reply."""
        self.replies[reply.seq] = reply
        self.at_s[reply.seq] = time.monotonic()

    def latencies_s(self) -> NDArray[np.float64]:
        """From a frame's sending to its reply, by seq."""
        return np.array([self.at_s[seq] - self.sent_s[seq] for seq in sorted(self.at_s)])

    def longest_gap_s(self, start_s: float, end_s: float) -> float:
        """The longest time between two replies, of those that overlap a span of time."""
        times = np.sort(list(self.at_s.values()))
        before, after = times[:-1], times[1:]
        gaps = (after - before)[(after > start_s) & (before < end_s)]
        return float(gaps.max(initial=0.0))

    def poses(self) -> dict[int, NDArray[np.float64]]:
        """T_map_camera, [4, 4], of every frame that has one."""
        told = self.replies.items()
        return {
            seq: reply.T_map_camera.matrix()
            for seq, reply in told
            if reply.status in HAS_POSE and reply.T_map_camera is not None
        }

    def superseded(self) -> int:
        """Frames that a newer one replaced before it was tracked."""
        statuses = [reply.status for reply in self.replies.values()]
        return statuses.count(TrackingStatus.SUPERSEDED)

    def acknowledged_keyframes(self) -> list[int]:
        """Keyframes that the client was told of while nothing ailed their map."""
        told = self.replies.items()
        return sorted(seq for seq, r in told if r.keyframe and r.map_problem is None)


class Player(threading.Thread):
    """One client: a session of its own, streamed to its end whatever happens on the way."""

    def __init__(self, url: str, name: str, play: Play) -> None:
        super().__init__(name=name, daemon=True)
        self.heard = Heard()
        self.failure: PointSlamError | None = None
        self.may_end = threading.Event()
        if not play.holds_last:
            self.may_end.set()
        self._url = url
        self._play = play

    def run(self) -> None:
        """Create the session, play everything, reconnecting as often as needed."""
        play = self._play
        try:
            with Client(self._url) as client:
                client.create_session(
                    play.sequence.calibration,
                    name=self.name,
                    mode=play.mode,
                    T_map_first=play.sequence.frame(0).T_world_camera,
                )
            while self._next_seq() < play.num_frames:
                self._stream()
        except PointSlamError as error:
            self.failure = error

    def finish(self, timeout_s: float = 120.0) -> Heard:
        """Wait until everything was played.

        Raises:
            PointSlamError: the session could not be created, or not be taken up again.
        """
        self.may_end.set()
        self.join(timeout_s)
        if self.failure is not None:
            raise self.failure
        if self.is_alive():
            raise UnavailableError(f"{self.name} has not finished after {timeout_s:.0f} s")
        return self.heard

    def _stream(self) -> None:
        with Client(self._url) as client:
            wait_for(client.ready)
            session = client.session(self.name)
            try:
                for reply in session.stream(self._frames(session)):
                    self.heard.add(reply)
            except UnavailableError:
                self.heard.breaks += 1

    def _next_seq(self) -> int:
        return max(self.heard.replies, default=-1) + 1

    def _frames(self, session: Session) -> Iterator[FrameMessage]:
        """From the session's next number on; frames that are late follow at once."""
        play, first = self._play, session.next_seq
        start = time.monotonic()
        for seq in range(first, play.num_frames):
            time.sleep(max(0.0, start + (seq - first) / play.rate_hz - time.monotonic()))
            if seq == play.num_frames - 1:
                self.may_end.wait()
            image = play.sequence.frame(to_and_fro(seq, len(play.sequence)))
            self.heard.sent_s[seq] = time.monotonic()
            yield session.frame(image.rgb, image.depth, play.t_ns(seq))


def play_all(url: str, plays: dict[str, Play]) -> dict[str, Player]:
    """Start a client for each name."""
    players = {name: Player(url, name, play) for name, play in plays.items()}
    for player in players.values():
        player.start()
    return players
