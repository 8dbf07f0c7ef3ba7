"""HTTP: the refinement of a map as a job with events, and snapshots."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import JSONResponse, Response, StreamingResponse

from services.gateway import examples
from services.gateway.config import GatewayConfig
from services.gateway.decode import plain, read_json
from services.gateway.events import EventKind
from services.gateway.job_events import job_events
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from shared import codec
from shared.errors import InputError, NotFoundError
from shared.maps import (
    Empty,
    JobState,
    JobStatus,
    RefineRequest,
    SaveReply,
    SaveRequest,
)


def job_routes(sessions: Sessions) -> APIRouter:
    """The routes of refinement and of snapshots."""
    router = APIRouter()
    _add_refine_routes(router, sessions)
    _add_event_route(router, sessions)
    _add_save_route(router, sessions)
    return router


def _add_refine_routes(router: APIRouter, sessions: Sessions) -> None:
    limits = sessions.fabric.config.limits
    timeout_s = sessions.fabric.config.mapping.question_timeout_s

    @router.post("/v1/sessions/{name}/refine", status_code=202, openapi_extra=examples.REFINE)
    async def refine(name: str, request: Request) -> Response:
        """Start to optimise on all keyframes; it goes on when its owner dies and is replaced."""
        session = await sessions.get(name)
        wanted = plain(RefineRequest, await read_json(request))
        if not 0 < wanted.iterations <= limits.max_refine_iterations:
            raise InputError("iterations", f"must be 1 to {limits.max_refine_iterations}")
        await session.flush(timeout_s)
        job: JobStatus = await session.owner.ask("refine", wanted, JobStatus, timeout_s)
        location = {"Location": f"/v1/sessions/{session.name}/refine"}
        return JSONResponse(codec.to_json(job), 202, location)

    @router.get("/v1/sessions/{name}/refine")
    async def get_refinement(name: str) -> dict[str, Any]:
        """The present or the last refinement."""
        return codec.to_json(await _refinement(await sessions.get(name), sessions.fabric.config))

    @router.delete("/v1/sessions/{name}/refine")
    async def interrupt(name: str) -> dict[str, Any]:
        """Stop the refinement; what it has done stays. A live map rests until the next frame."""
        owner = (await sessions.get(name)).owner
        return codec.to_json(await owner.ask("interrupt", Empty(), JobStatus, timeout_s))


def _add_event_route(router: APIRouter, sessions: Sessions) -> None:
    @router.get("/v1/sessions/{name}/refine/events", response_class=StreamingResponse)
    async def events(name: str) -> Response:
        """Server-sent events: `progress` with the job as JSON whenever it moves, then `end`."""
        session, config = await sessions.get(name), sessions.fabric.config
        first = await _refinement(session, config)
        if first.state is JobState.NONE:
            raise NotFoundError(f"session {session.name} was never refined")
        return job_events(first, lambda: _refinement(session, config), config.stream)


def _add_save_route(router: APIRouter, sessions: Sessions) -> None:
    config = sessions.fabric.config.mapping

    @router.post("/v1/sessions/{name}/save")
    async def save(name: str) -> dict[str, Any]:
        """Write a snapshot now; answers when it is on disk."""
        session = await sessions.get(name)
        await session.flush(config.question_timeout_s)
        wait_s = config.export_timeout_s
        saved: SaveReply = await session.owner.ask("save", SaveRequest(), SaveReply, wait_s)
        session.live.events.add(EventKind.SAVED, map_revision=saved.revision, bytes=saved.bytes)
        return codec.to_json(saved)


async def _refinement(session: Session, config: GatewayConfig) -> JobStatus:
    timeout_s = config.mapping.question_timeout_s
    return await session.owner.ask("refinement", Empty(), JobStatus, timeout_s)
