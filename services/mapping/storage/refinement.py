"""The refinement of a session's map as a job that outlives its owner.

Its state is on disk when it is acknowledged and when it ends. How far it is goes with each
snapshot, beside the map that it made: an owner that takes the session up goes on from there, and
what was done after the snapshot is done again.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from services.mapping.storage.folders import write_atomically
from shared import codec
from shared.errors import ConflictError, InputError, PointSlamError
from shared.maps import JobState, JobStatus

LOGGER = logging.getLogger(__name__)
_FILE = "refinement.msgpack"


class Refinement:
    """The present or the last refinement of a session; safe from any thread."""

    def __init__(
        self,
        folder: Path,
        saved: JobStatus,
        check_owner: Callable[[], None] = lambda: None,
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Take up what a session's folder says.

        Args:
            saved: the refinement of the snapshot that the map is taken up from.
            check_owner: raises before the folder is written to if it is another owner's by now.
            ended: called when one has ended.
        """
        self._check_owner = check_owner
        self._ended = ended
        self._path = folder / _FILE
        self._lock = threading.Lock()
        self._status = _taken_up(self._path, saved)

    @property
    def status(self) -> JobStatus:
        """How far it is."""
        return self._status

    def start(self, iterations: int) -> JobStatus:
        """A new refinement; on disk when this returns.

        Raises:
            ConflictError: one is running.
            GoneError, StorageError: it could not be written; there is no new one.
        """
        with self._lock:
            if self._status.is_running:
                raise ConflictError("a refinement is running; interrupt it first")
            self._set(JobStatus(JobState.RUNNING, 0, iterations, job=self._status.job + 1))
            return self._status

    def count(self, psnr_db: float | None) -> None:
        """One iteration more is done, with the running PSNR of the training views."""
        with self._lock:
            done = self._status.iterations_done + 1
            self._status = replace(self._status, iterations_done=done, psnr_db=psnr_db)
            if self._status.is_running and done >= self._status.iterations_total:
                self._end(JobState.DONE)

    def interrupt(self) -> JobStatus:
        """End it after its present iteration; what it has done stays."""
        with self._lock:
            if self._status.is_running:
                self._end(JobState.INTERRUPTED)
            return self._status

    def fail(self, reason: str) -> None:
        """End it, saying why."""
        with self._lock:
            if self._status.is_running:
                self._end(JobState.FAILED, reason)

    def _end(self, state: JobState, error: str = "") -> None:
        ended = replace(self._status, state=state, error=error)
        try:
            self._set(ended)
        except PointSlamError as failure:  # it has ended all the same
            LOGGER.error("the end of a refinement is not on disk: %s", failure)
            self._status = ended
        self._ended()

    def _set(self, status: JobStatus) -> None:
        self._check_owner()
        write_atomically(self._path, codec.pack(status))
        self._status = status


def _taken_up(path: Path, saved: JobStatus) -> JobStatus:
    try:
        status = codec.unpack(JobStatus, path.read_bytes())
    except FileNotFoundError:
        return saved
    except InputError as error:
        LOGGER.warning("%s: passed over (%s)", path, error)
        return saved
    if not status.is_running:
        return status
    done = saved.iterations_done if saved.job == status.job else 0
    return replace(status, iterations_done=done)
