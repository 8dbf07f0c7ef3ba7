"""The thread that tidies up behind a mapper's sessions, now and then."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence

from shared.errors import PointSlamError

LOGGER = logging.getLogger(__name__)


class Janitor:
    """Does its tasks one after the other every `interval_s` seconds, until it is stopped."""

    def __init__(self, interval_s: float, tasks: Sequence[Callable[[], None]]) -> None:
        self._interval_s = interval_s
        self._tasks = tasks
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="janitor", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Begin nothing more."""
        self._is_stopped.set()

    def _run(self) -> None:
        while not self._is_stopped.wait(self._interval_s):
            for task in self._tasks:
                try:
                    task()
                except (
                    PointSlamError,
                    OSError,
                ) as error:  # a disk that refuses may be well next time
                    LOGGER.warning("not tidied up: %s", error)
