"""The thread that works on one session's map, entry by entry in the order of the log.

Offline, every entry gives a fixed number of iterations, so that a run is deterministic. Live, the
map is optimised whenever it has keyframes and no entry waits.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

from services.mapping.config import MappingConfig
from services.mapping.map_state import MapState
from services.mapping.pipeline import Mapper, NewKeyframe
from services.mapping.priority import give_way
from services.mapping.spare_memory import give_back
from services.mapping.storage.refinement import Refinement
from services.mapping.turns import Turns
from services.mapping.views.training_views import TrainingView
from shared.errors import NotFoundError, UnavailableError
from shared.maps import JobStatus

LOGGER = logging.getLogger(__name__)
OFFLINE, LIVE = "offline", "live"
T = TypeVar("T")


@dataclass
class WorkTimes:
    """Seconds spent optimising."""

    mapping_s: float = 0.0
    refinement_s: float = 0.0


class MapWorker:
    """Owns a session's mapper and the queue of what it has yet to see."""

    def __init__(
        self, mapper: Mapper, refinement: Refinement, mode: str, config: MappingConfig
    ) -> None:
        self._mapper = mapper
        self._is_live = mode == LIVE
        self._config = config
        self._turns = Turns()
        self._changed = threading.Condition()
        self._queue: deque[NewKeyframe | None] = deque()  # None: a frame that is no keyframe
        self._is_busy = False
        self._is_stopping = False
        self._last_entry_s = -math.inf  # a map that was taken up stays as it was until one comes
        self.refinement = refinement
        self.times = WorkTimes()
        self._thread = threading.Thread(target=self._run, name="map-worker", daemon=True)

    def start(self) -> None:
        """Begin to work through the queue."""
        self._thread.start()

    @property
    def pending(self) -> int:
        """Entries not yet worked through."""
        return len(self._queue) + self._is_busy

    @property
    def stages_ms(self) -> dict[str, float]:
        """Median time of each stage, milliseconds."""
        return self._mapper.stages.medians()

    @property
    def iterations(self) -> int:
        """Iterations done on the map so far."""
        return self._mapper.iterations

    def submit(self, keyframe: NewKeyframe | None) -> None:
        """Queue the map's share of one log entry."""
        with self._changed:
            self._queue.append(keyframe)
            self._last_entry_s = time.monotonic()
            self._changed.notify_all()

    def wait_for_room(self) -> None:
        """Wait until at most `max_pending` entries are pending."""
        owner = self._config.owner
        limit = owner.max_pending_live if self._is_live else owner.max_pending
        self._wait(lambda: self.pending <= limit)

    def drain(self) -> None:
        """Wait until every entry is worked through.

        Raises:
            UnavailableError: `stop` came first.
        """
        self._wait(lambda: self.pending == 0)
        if self.pending:
            raise UnavailableError("the session is being closed")

    def visit(self, question: Callable[[Mapper], T]) -> T:
        """Ask the mapper something between two of its steps."""
        with self._turns.visit():
            return question(self._mapper)

    def keyframe(self, seq: int) -> TrainingView:
        """A keyframe of the map; waits while entries are pending that may bring it.

        Raises:
            NotFoundError: there is none of that seq.
        """
        self._wait(lambda: seq in self._mapper.views or self.pending == 0)
        if seq not in self._mapper.views:
            raise NotFoundError(f"no keyframe {seq} in the map")
        return self._mapper.views[seq]

    def capture(self) -> tuple[MapState, JobStatus]:
        """The map and its refinement at one moment.

        The memory for it is made ready first: the optimisation rests while it is copied only.
        """
        room = self.room()
        return self.visit(lambda mapper: (mapper.state(room), self.refinement.status))

    def room(self) -> dict[str, Tensor]:
        """Memory for the state of the anchors as they are about now."""
        give_back()
        return self._mapper.anchors.rows.room()

    def refine(self, iterations: int) -> JobStatus:
        """Start a refinement; it gives way to new entries.

        Raises:
            ConflictError: one is running.
            StorageError: the disk refused.
        """
        status = self.refinement.start(iterations)
        with self._changed:
            self._changed.notify_all()
        return status

    def interrupt(self) -> JobStatus:
        """End a refinement after its present iteration; a live map rests until an entry comes."""
        with self._changed:
            self._last_entry_s = -math.inf
        return self.refinement.interrupt()

    def stop(self) -> None:
        """Finish the present step and end the thread; what is queued stays undone."""
        with self._changed:
            self._is_stopping = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join()

    def _wait(self, is_reached: Callable[[], bool]) -> None:
        with self._changed:
            self._changed.wait_for(lambda: is_reached() or self._is_stopping)

    def _run(self) -> None:
        give_way(self._config.owner.niceness)
        while (step := self._next()) is not None:
            try:
                step()
            except Exception as error:  # the thread must outlive a keyframe that makes no sense
                LOGGER.exception("a step of the map failed")
                self.refinement.fail(str(error))
            with self._changed:
                self._is_busy = False
                self._changed.notify_all()

    def _next(self) -> Callable[[], None] | None:
        """Wait for something to do; None when it is time to stop."""
        with self._changed:
            while not self._is_stopping:
                if self._queue:
                    self._is_busy = True
                    keyframe = self._queue.popleft()
                    return lambda: self._work_through(keyframe)
                if self.refinement.status.is_running:
                    return self._refine_once
                idle_s = time.monotonic() - self._last_entry_s
                if self._is_live and idle_s < self._config.owner.live_idle_s:
                    return self._iterate_live
                self._changed.wait()
            return None

    def _work_through(self, keyframe: NewKeyframe | None) -> None:
        start = time.monotonic()
        if keyframe is not None:
            with self._turns.step():
                self._mapper.insert_keyframe(keyframe)
        for _ in range(0 if self._is_live else self._config.schedule.iterations_per_frame):
            self._iterate()
        self.times.mapping_s += time.monotonic() - start

    def _iterate(self) -> None:
        with self._turns.step():
            self._mapper.iterate()

    def _iterate_live(self) -> None:
        start = time.monotonic()
        if len(self._mapper.views) == 0:
            self._wait_for_entry()
            return
        self._iterate()
        self.times.mapping_s += time.monotonic() - start

    def _wait_for_entry(self) -> None:
        with self._changed:
            self._changed.wait_for(
                lambda: self._queue or self._is_stopping or self.refinement.status.is_running
            )

    def _refine_once(self) -> None:
        start, job = time.monotonic(), self.refinement.status
        with self._turns.step():  # a snapshot finds the map and the count of one moment
            self._mapper.refine(job.iterations_done / job.iterations_total)
            self.refinement.count(self._mapper.psnr_db)
        self.times.refinement_s += time.monotonic() - start
