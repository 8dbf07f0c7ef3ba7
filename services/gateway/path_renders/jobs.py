"""Path renders under way and done: one at a time of a session, each kept for a while."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import os
import threading
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from services.gateway.config import GatewayConfig
from services.gateway.map_queries import ask_render
from services.gateway.path_renders.files import SUFFIXES, PictureFile, open_file
from services.gateway.path_renders.temporary import ProcessFolder
from services.gateway.path_renders.views import PathViews
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from shared.errors import (
    ConflictError,
    NotFoundError,
    PointSlamError,
    StorageError,
    UnavailableError,
)
from shared.maps import JobState
from shared.path_renders import PathRenderStatus

LOGGER = logging.getLogger(__name__)
_LOOK_S = 0.5  # between looks whether the session of a kept file is still there
_STEPS_DOWN, _LOWEST = 10, 19  # of the writers' priority


class PathRender:
    """One job: its views are drawn one after the other; nothing else of the session waits."""

    def __init__(self, session: Session, views: PathViews, folder: Path) -> None:
        job, format = uuid.uuid4().hex, views.request.format
        self.session = session
        self.path = folder / f"{job}.{SUFFIXES[format]}"  # by which OpenCV knows the container
        self.status = PathRenderStatus(
            job=job,
            state=JobState.RUNNING,
            frames_done=0,
            frames_total=len(views.T_map_cameras),
            format=format,
        )
        self._views = views
        # One thread of its own: a writer is not for several, and tracked frames go first.
        self._writing = ThreadPoolExecutor(1, "path-render", _yield_to_frames)
        self.task: asyncio.Task[None] | None = None

    async def run(self, config: GatewayConfig) -> None:
        """Draw and write every view; how it ended is in `status`."""
        try:
            with self.session.usage.held():
                await self._draw(config)
            self._end(JobState.DONE, bytes=self.path.stat().st_size)
        except asyncio.CancelledError:
            self._end(JobState.INTERRUPTED)
            raise
        except (PointSlamError, OSError) as error:
            LOGGER.warning("%s: path render: %s", self.session.name, error)
            self._end(JobState.FAILED, error=str(error))
        finally:
            self._writing.shutdown(wait=False)

    async def _draw(self, config: GatewayConfig) -> None:
        file: PictureFile = await self._write(open_file, self.path, self._views)
        try:
            for i in range(self.status.frames_total):
                reply = await ask_render(self.session, self._views.render_request(i), config)
                await self._write(file.add, reply)
                self.status = dataclasses.replace(self.status, frames_done=i + 1)
                self._check_bytes(config.limits.max_path_bytes)
        finally:
            await asyncio.shield(self._write(file.close))

    def _write(self, work: Callable[..., Any], *arguments: Any) -> asyncio.Future[Any]:
        return asyncio.get_running_loop().run_in_executor(self._writing, work, *arguments)

    def _check_bytes(self, limit: int) -> None:
        if self.path.stat().st_size > limit:
            raise StorageError(
                f"{self.status.frames_done} of {self.status.frames_total} pictures take more than "
                f"{limit >> 20} MiB: ask for fewer, smaller, or a video"
            )

    def _end(self, state: JobState, **what: Any) -> None:
        self.status = dataclasses.replace(self.status, state=state, **what)
        if state is not JobState.DONE:
            self.path.unlink(missing_ok=True)


class PathRenders:
    """The jobs of a gateway, by session and number."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions
        self._config = sessions.fabric.config
        self._folder = ProcessFolder()
        self._jobs: dict[str, PathRender] = {}

    def start(self, session: Session, views: PathViews) -> PathRenderStatus:
        """Begin to draw.

        Raises:
            ConflictError: another path of the session is being drawn.
            UnavailableError: too many are, or are kept.
        """
        self.require_room(session)
        job = PathRender(session, views, self._folder.path)
        self._jobs[job.status.job] = job
        job.task = asyncio.create_task(self._live(job))
        return job.status

    def require_room(self, session: Session) -> None:
        """Refuse where `start` would."""
        running = [job for job in self._jobs.values() if job.status.is_running]
        if any(job.session is session for job in running):
            raise ConflictError(f"a path of session {session.name} is being drawn already")
        if len(running) >= self._config.limits.max_path_renders:
            raise UnavailableError(f"{len(running)} paths are being drawn: try again later")

    def find(self, session: Session, job: str) -> PathRender:
        """A job of this session.

        Raises:
            NotFoundError: there is none of that number, or it was too long ago.
        """
        found = self._jobs.get(job)
        if found is None or found.session is not session:
            raise NotFoundError(f"no path render {job[:40]!r} of session {session.name} here")
        return found

    async def cancel(self, job: PathRender) -> PathRenderStatus:
        """End a job, and let its file go."""
        if job.task is not None:
            job.task.cancel()
            await asyncio.wait([job.task])
        return job.status

    async def _live(self, job: PathRender) -> None:
        """Draw, then keep the file for a while, but no longer than the session."""
        try:
            await job.run(self._config)
            self._drop_oldest()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._config.path_keep_s):
                    while self._sessions.is_serving(job.session):
                        await asyncio.sleep(_LOOK_S)
        finally:
            job.path.unlink(missing_ok=True)
            self._jobs.pop(job.status.job, None)

    def _drop_oldest(self) -> None:
        ended = [job for job in self._jobs.values() if not job.status.is_running]
        for job in ended[: -self._config.limits.max_path_renders]:
            if job.task is not None:
                job.task.cancel()


def _yield_to_frames() -> None:
    thread = threading.get_native_id()  # of Linux: a priority is a thread's own
    now = os.getpriority(os.PRIO_PROCESS, thread)
    os.setpriority(os.PRIO_PROCESS, thread, min(now + _STEPS_DOWN, _LOWEST))
