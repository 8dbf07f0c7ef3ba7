"""A folder for this process's files that does not outlive it for long."""

from __future__ import annotations

import fcntl
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

_PREFIX, _LOCK = "pointslam-renders-", "lock"


class ProcessFolder:
    """A temporary folder, locked while its process lives.

    The kernel lets a lock go however a process ends, so the next one knows which folders of others
    nobody will clear, and clears them.
    """

    def __init__(self, parent: Path | None = None) -> None:
        parent = parent or Path(tempfile.gettempdir())
        _clear_left(parent)
        self._folder = tempfile.TemporaryDirectory(prefix=_PREFIX, dir=parent)
        self.path = Path(self._folder.name)
        lock = self.path / "locking"
        self._lock = lock.open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        lock.rename(self.path / _LOCK)  # others never see it unlocked while we live

    def close(self) -> None:
        """Remove the folder and what is in it."""
        self._folder.cleanup()
        self._lock.close()


def _clear_left(parent: Path) -> None:
    """Remove folders whose processes are gone; those of other users are theirs."""
    for lock in parent.glob(f"{_PREFIX}*/{_LOCK}"):
        with suppress(OSError), lock.open("r") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.parent, ignore_errors=True)
