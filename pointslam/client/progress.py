"""How far the work of a map is, read from its state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from shared.errors import PointSlamError

POLL_S = 0.25
Progress = Callable[[int, int], None]  # done, of so many


def refinement(info: dict[str, Any]) -> tuple[bool, int, int]:
    """Whether a refinement runs, iterations done, of so many.

    Raises:
        PointSlamError: it failed.
    """
    job = info["refinement"]
    if job["error"]:
        raise PointSlamError(f"the refinement failed: {job['error']}")
    return job["is_running"], job["iterations_done"], job["iterations_total"]


def pending(info: dict[str, Any]) -> int:
    """Answered frames that the map has not yet worked through."""
    return info["pending"] + info["tracking"]["undelivered"]
