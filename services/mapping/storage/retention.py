"""How long sessions stay on disk: the oldest go first, never one that is open or pinned."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from services.mapping.config import RetentionConfig
from services.mapping.storage.folders import storage_errors

_PINNED = "pinned"
_DAY_S = 86_400.0


@dataclass(frozen=True)
class StoredSession:
    """What a session takes on disk, and when it was written to last (seconds since 1970)."""

    name: str
    num_bytes: int
    used_s: float
    is_kept: bool = False  # open or pinned


def overdue(stored: Iterable[StoredSession], rule: RetentionConfig, now_s: float) -> list[str]:
    """Names of the sessions that a rule lets go, oldest first."""
    oldest_first = sorted(stored, key=lambda each: each.used_s)
    excess = sum(each.num_bytes for each in oldest_first) - 1e9 * rule.max_gb
    names = []
    for each in oldest_first:
        if each.is_kept:
            continue
        is_old = rule.max_days > 0 and now_s - each.used_s > rule.max_days * _DAY_S
        if is_old or (rule.max_gb > 0 and excess > 0):
            names.append(each.name)
            excess -= each.num_bytes
    return names


def stored_session(path: Path, is_open: bool) -> StoredSession:
    """The session in a folder.

    Raises:
        StorageError: the folder cannot be read.
    """
    with storage_errors(str(path)):
        stats = [file.stat() for file in path.rglob("*") if file.is_file()]
    num_bytes = sum(stat.st_size for stat in stats)
    used_s = max((stat.st_mtime for stat in stats), default=0.0)
    return StoredSession(path.name, num_bytes, used_s, is_open or is_pinned(path))


def is_pinned(path: Path) -> bool:
    """Whether a session's folder is kept for ever."""
    return (path / _PINNED).exists()


def set_pinned(path: Path, is_pinned: bool) -> None:
    """Keep a session's folder for ever, or no longer.

    Raises:
        StorageError: the disk refused.
    """
    with storage_errors(str(path)):
        if is_pinned:
            (path / _PINNED).touch()
        else:
            (path / _PINNED).unlink(missing_ok=True)
