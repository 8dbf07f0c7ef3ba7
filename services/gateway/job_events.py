"""Server-sent events of a job that goes on without those who watch it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Protocol, TypeVar

from starlette.responses import Response, StreamingResponse

from services.gateway.config import StreamConfig
from shared import codec


class Status(Protocol):
    """How far a job is; a dataclass."""

    @property
    def is_running(self) -> bool:
        """Whether there is more to come."""
        ...


S = TypeVar("S", bound=Status)


def job_events(first: S, look: Callable[[], Awaitable[S]], stream: StreamConfig) -> Response:
    """`progress` with the job as JSON whenever it has moved, then `end`."""
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(_events(first, look, stream), 200, headers, "text/event-stream")


async def _events(
    job: S, look: Callable[[], Awaitable[S]], stream: StreamConfig
) -> AsyncIterator[str]:
    """An event at each look that finds the job changed, a comment where nothing moves."""
    interval_s, quiet_s = stream.event_interval_s, 0.0
    yield _event(job)
    while job.is_running:
        await asyncio.sleep(interval_s)
        before, job = job, await look()
        quiet_s = 0.0 if job != before else quiet_s + interval_s
        if job != before:
            yield _event(job)
        elif quiet_s >= stream.ping_interval_s:
            quiet_s = 0.0
            yield ": nothing new\n\n"


def _event(job: Status) -> str:
    name = "progress" if job.is_running else "end"
    return f"event: {name}\ndata: {json.dumps(codec.to_json(job))}\n\n"
