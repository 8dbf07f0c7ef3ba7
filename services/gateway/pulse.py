"""How a session goes at this moment: how many frames a second, and how well they are tracked."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from shared.stream import FrameReply

_WINDOW = 30  # answers that the frame rate is the mean over
_IDLE_S = 2.0  # a session without an answer for so long has no frame rate


class Pulse:
    """The last answers of a session."""

    def __init__(self) -> None:
        self._answered_s: deque[float] = deque(maxlen=_WINDOW)
        self._last: FrameReply | None = None

    def beat(self, reply: FrameReply) -> None:
        """Note an answer."""
        self._answered_s.append(time.monotonic())
        self._last = reply

    def state(self) -> dict[str, Any]:
        """The last status, its quality, and frames per second, as plain JSON values.

        All are None before the first frame; the frame rate is 0 where frames ceased to come.
        """
        last = self._last
        return {
            "status": str(last.status) if last else None,
            "inlier_share": last.inlier_share if last else None,
            "pos_std_m": last.pos_std_m if last else None,
            "rot_std_deg": last.rot_std_deg if last else None,
            "answer_ms": last.timings_ms.get("gateway") if last else None,
            "frame_rate_hz": self._frame_rate_hz(time.monotonic()) if last else None,
            "map_problem": last.map_problem.reason if last and last.map_problem else None,
        }

    def _frame_rate_hz(self, now_s: float) -> float:
        times_s = self._answered_s
        if now_s - times_s[-1] > _IDLE_S or len(times_s) < 2:
            return 0.0
        return (len(times_s) - 1) / max(times_s[-1] - times_s[0], 1e-6)
