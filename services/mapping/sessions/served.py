"""A session that is open at a mapper: the questions that it answers, and its end."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from services.mapping.sessions.session import Session
from shared.maps import (
    Empty,
    ExportRequest,
    KeyframeRequest,
    RefineRequest,
    RenderRequest,
    SaveRequest,
    TrajectoryRequest,
)
from shared.tracks import Advance, CandidatesRequest, ClaimRequest, ContextRequest


@dataclass
class Served:
    """An open session and what must be undone to close it."""

    session: Session
    advances: ThreadPoolExecutor  # one thread: the entries of a session stay in order
    stops: list[Callable[[], None]] = field(default_factory=list)
    used_s: float = field(default_factory=time.monotonic)

    def noting_use(self, answer: Callable[[Any], object]) -> Callable[[Any], object]:
        """`answer`, noting that somebody asked."""

        def noted(request: Any) -> object:
            self.used_s = time.monotonic()
            return answer(request)

        return noted


def answers(session: Session) -> list[tuple[str, type, Callable[[Any], object]]]:
    """The questions of `Keys.session`, with what they carry and who answers."""
    ledger = session.ledger
    return [
        ("claim", ClaimRequest, session.claim),
        ("advance", Advance, session.advance),
        ("context", ContextRequest, ledger.context),
        ("candidates", CandidatesRequest, ledger.candidates),
        ("keyframes", Empty, lambda _: ledger.poses()),
        ("render", RenderRequest, session.render),
        ("keyframe", KeyframeRequest, session.images.answer),
        ("export", ExportRequest, session.export),
        ("refine", RefineRequest, session.refine),
        ("refinement", Empty, lambda _: session.refinement),
        ("interrupt", Empty, lambda _: session.interrupt()),
        ("save", SaveRequest, lambda _: session.save()),
        ("info", Empty, lambda _: session.info()),
        ("trajectory", TrajectoryRequest, lambda _: session.trajectory()),
    ]


def withdraw(served: Served, is_saved: bool) -> None:
    """Answer no longer and close the session, with a snapshot or without."""
    for stop in served.stops:
        stop()
    served.advances.shutdown(wait=True, cancel_futures=True)  # none may find the log closed
    served.session.close(is_saved)
