"""What happens to a session and people want to know of: lost, found again, loops, owners."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from shared.frames import HAS_POSE, TrackingStatus

_KEPT = 200


class EventKind(StrEnum):
    """What happened."""

    LOST = "lost"  # the camera; seq
    RELOCALIZED = "relocalized"  # after it was lost; seq, lost_frames
    LOOP_CLOSED = "loop_closed"  # the map was bent; loops, max_shift_m
    OWNER_CHANGED = "owner_changed"  # another mapper, or the same one again; mapper, epoch
    SAVED = "saved"  # revision, bytes


@dataclass(frozen=True)
class SessionEvent:
    """One thing that happened; numbers only grow, also when the gateway is started again."""

    number: int
    kind: EventKind
    time_s: float  # of this machine's clock, since 1970
    details: dict[str, Any] = field(default_factory=dict)


class SessionEvents:
    """The last events of a session; owned by the event loop."""

    def __init__(self) -> None:
        self._kept: deque[SessionEvent] = deque(maxlen=_KEPT)
        # Microseconds since 1970: what a watcher heard from an earlier life has smaller numbers.
        self._number = time.time_ns() // 1000
        self._lost_frames = 0

    def add(self, kind: EventKind, **details: Any) -> None:
        """Note that something happened."""
        self._number += 1
        self._kept.append(SessionEvent(self._number, kind, time.time(), details))

    def hear(self, seq: int, status: TrackingStatus | None) -> None:
        """Note where the camera was lost and where it was found again."""
        if status is TrackingStatus.LOST:
            if self._lost_frames == 0:
                self.add(EventKind.LOST, seq=seq)
            self._lost_frames += 1
        elif status in HAS_POSE and self._lost_frames:
            self.add(EventKind.RELOCALIZED, seq=seq, lost_frames=self._lost_frames)
            self._lost_frames = 0

    def after(self, number: int) -> list[SessionEvent]:
        """The kept events after one, oldest first; all of them after one that we never sent."""
        is_ours = number <= self._number
        return [event for event in self._kept if not is_ours or event.number > number]
