"""HTTP: views along a path as one file, drawn by a job."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse

from services.gateway import examples
from services.gateway.decode import plain, read_json
from services.gateway.job_events import job_events
from services.gateway.path_renders.files import MEDIA_TYPES, SUFFIXES
from services.gateway.path_renders.jobs import PathRender, PathRenders
from services.gateway.path_renders.views import check, plan
from services.gateway.sessions import Sessions
from shared import codec
from shared.errors import ConflictError
from shared.maps import JobState
from shared.path_renders import PathRenderRequest, PathRenderStatus

_JOB = "/v1/sessions/{name}/renders/{job}"


def path_render_routes(sessions: Sessions) -> APIRouter:
    """The routes of path renders."""
    router, renders = APIRouter(), PathRenders(sessions)
    _add_start_route(router, sessions, renders)
    _add_job_routes(router, sessions, renders)
    return router


def _add_start_route(router: APIRouter, sessions: Sessions, renders: PathRenders) -> None:
    config = sessions.fabric.config

    @router.post("/v1/sessions/{name}/renders", status_code=202, openapi_extra=examples.RENDER_PATH)
    async def render_path(name: str, request: Request) -> Response:
        """Draw views along a path into a video or an archive; one path of a session at a time.

        `path` is where the camera goes (trajectory, keyframes, poses, orbit), `format` what is
        written (webm, mp4, or jpeg and png in a zip), `layer` what is drawn (colour, depth,
        confidence). The job and its file are of this gateway alone, and kept for `path_keep_s`.
        """
        session = await sessions.get(name)
        wanted = plain(PathRenderRequest, await read_json(request))
        check(wanted, config.limits)
        renders.require_room(session)
        status = renders.start(session, await plan(session, wanted, config))
        location = {"Location": f"/v1/sessions/{session.name}/renders/{status.job}"}
        return JSONResponse(codec.to_json(status), 202, location)


def _add_job_routes(router: APIRouter, sessions: Sessions, renders: PathRenders) -> None:
    async def find(name: str, job: str) -> PathRender:
        return renders.find(await sessions.get(name), job)

    @router.get(_JOB)
    async def get_path_render(name: str, job: str) -> dict[str, Any]:
        """How far it is."""
        return codec.to_json((await find(name, job)).status)

    @router.delete(_JOB)
    async def cancel_path_render(name: str, job: str) -> dict[str, Any]:
        """End it, or let its file go."""
        return codec.to_json(await renders.cancel(await find(name, job)))

    @router.get(f"{_JOB}/events", response_class=StreamingResponse)
    async def path_render_events(name: str, job: str) -> Response:
        """Server-sent events: `progress` with the job as JSON whenever it moves, then `end`."""
        found = await find(name, job)

        async def look() -> PathRenderStatus:
            return found.status

        return job_events(found.status, look, sessions.fabric.config.stream)

    @router.get(
        f"{_JOB}/file",
        response_class=FileResponse,
        responses=examples.binary(*dict.fromkeys(MEDIA_TYPES.values())),
    )
    async def path_render_file(name: str, job: str) -> Response:
        """The video or the archive; 409 until it is done."""
        found = await find(name, job)
        status = found.status
        if status.state is not JobState.DONE:
            raise ConflictError(
                f"{status.state}, {status.frames_done} of {status.frames_total} pictures are drawn"
            )
        filename = f"{found.session.name}.{SUFFIXES[status.format]}"
        return FileResponse(found.path, media_type=MEDIA_TYPES[status.format], filename=filename)
