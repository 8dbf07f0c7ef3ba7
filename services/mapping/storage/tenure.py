"""The sessions that this process owns: claimed, renewed, lost.

A mapper may acknowledge only while it is sure to be the owner, and the others must be sure when it
is not: it counts 3/4 of the lease from before its last renewal, by a clock that also runs while
the process is frozen, and they wait for the whole. What a frozen owner wrote to its log
afterwards is cut off by the next one (`SessionFolder.take_up`).
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from services.mapping.storage.leases import LeaseStore
from shared.errors import SteppedDownError, StorageError

LOGGER = logging.getLogger(__name__)
_SURE_SHARE = 0.75  # of the lease, in which its owner may act
_RENEWALS = 4  # a lease


@dataclass(frozen=True)
class Lease:
    """One session in our hands, in one epoch."""

    session: str
    epoch: int
    is_valid: Callable[[], bool]

    def check(self) -> None:
        """Refuse to act for a session that another mapper may own by now.

        Raises:
            SteppedDownError: the lease ran out or was taken; whoever asked finds the owner anew.
        """
        if not self.is_valid():
            raise SteppedDownError(f"session {self.session}: epoch {self.epoch} is over")


@dataclass
class _Held:
    epoch: int
    renewed_s: float  # monotonic; taken before the store was asked


class Tenure:
    """All leases of a process and the thread that renews them; safe from any thread."""

    def __init__(
        self, store: LeaseStore, name: str, ttl_s: float, lost: Callable[[str, int], None]
    ) -> None:
        self._store = store
        self._owner = process_identity(name)
        self._ttl_s = ttl_s
        self._lost = lost
        self._held: dict[str, _Held] = {}
        self._lock = threading.Lock()
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._renew_all, name="leases", daemon=True)
        self._thread.start()

    def claim(self, session: str, above: int) -> Lease:
        """Become a session's owner, in an epoch larger than `above`.

        A dead owner on this machine is succeeded at once, any other when its lease has ended.

        Raises:
            ConflictError: somebody else owns it.
            StorageError: the store cannot be reached.
        """
        holder = self._store.holder(session)
        departed = holder.owner if holder and is_departed(holder.owner) else ""
        now = time.monotonic()
        epoch = self._store.claim(session, self._owner, above, self._ttl_s, departed)
        with self._lock:
            self._held[session] = _Held(epoch, now)
        return Lease(session, epoch, lambda: self.is_held(session, epoch))

    def is_held(self, session: str, epoch: int) -> bool:
        """Whether we are sure to own a session in an epoch."""
        with self._lock:
            held = self._held.get(session)
        is_fresh = held is not None and time.monotonic() - held.renewed_s < self._sure_s
        return held is not None and held.epoch == epoch and is_fresh

    def is_leased(self, session: str) -> bool:
        """Whether the lease of a session is running, ours or another mapper's.

        Raises:
            StorageError: the store cannot be reached.
        """
        holder = self._store.holder(session)
        return holder is not None and holder.left_s > 0

    def release(self, session: str) -> None:
        """Let another mapper have a session at once; a store out of reach lets it end by itself."""
        with self._lock:
            held = self._held.pop(session, None)
        if held is None:
            return
        try:
            self._store.release(session, self._owner, held.epoch)
        except StorageError as error:
            LOGGER.warning("%s: not released: %s", session, error)

    def forget(self, session: str) -> None:
        """Remove a deleted session from the store."""
        with self._lock:
            self._held.pop(session, None)
        self._store.forget(session)

    def close(self) -> None:
        """Stop renewing and disconnect; what is still held ends by itself."""
        self._is_closed.set()
        self._thread.join()
        self._store.close()

    @property
    def _sure_s(self) -> float:
        return _SURE_SHARE * self._ttl_s

    def _renew_all(self) -> None:
        while not self._is_closed.wait(self._ttl_s / _RENEWALS):
            with self._lock:
                held = {session: lease.epoch for session, lease in self._held.items()}
            for session, epoch in held.items():
                self._renew(session, epoch)

    def _renew(self, session: str, epoch: int) -> None:
        now = time.monotonic()
        try:
            is_ours = self._store.renew(session, self._owner, epoch, self._ttl_s)
        except StorageError as error:
            LOGGER.warning("%s: lease not renewed: %s", session, error)
            return
        with self._lock:
            held = self._held.get(session)
            if held is None or held.epoch != epoch:
                return
            if is_ours:
                held.renewed_s = now
                return
            del self._held[session]
        LOGGER.warning("%s: another mapper took it; epoch %d is over", session, epoch)
        self._lost(session, epoch)


def process_identity(name: str) -> str:
    """A mapper's name with the process behind it, so that a namesake is somebody else."""
    return f"{name}@{_place()}:{os.getpid()}"


def is_departed(owner: str) -> bool:
    """Whether an owner was a process of this machine that is dead; false where we cannot know."""
    place, _, pid = owner.rpartition("@")[2].rpartition(":")
    if place != _place() or not pid.isdecimal() or not Path("/proc/self").exists():
        return False
    return not Path(f"/proc/{pid}").exists()


def _place() -> str:
    """This machine, and on it the container: process ids mean nothing outside of it."""
    space = Path("/proc/self/ns/pid")
    return f"{socket.gethostname()}/{os.readlink(space) if space.is_symlink() else '-'}".replace(
        "@", "_"
    )
