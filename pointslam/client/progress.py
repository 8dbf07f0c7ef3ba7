"""How far the work of a map is, read from its state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

POLL_S = 0.25
Progress = Callable[[int, int], None]  # done, of so many


def pending(info: dict[str, Any]) -> int:
    """Answered frames that the map has not yet worked through."""
    return info["pending"] + info["tracking"]["undelivered"]
