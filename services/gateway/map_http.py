"""HTTP: views of the map, and the map as a file."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from starlette.responses import Response, StreamingResponse

from services.gateway import examples
from services.gateway.config import GatewayConfig
from services.gateway.map_queries import ask_render, export_pieces
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from services.gateway.views import MEDIA_TYPES, View, intrinsics_from, mean_confidence, pose_from
from shared.maps import SUFFIXES, ExportFormat, RenderRequest


@dataclass(frozen=True)
class PoseQuery:
    """Camera to map: position in metres, quaternion; or both as JSON, as `pose` tells them."""

    px: float = 0.0
    py: float = 0.0
    pz: float = 0.0
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0
    qw: float = 1.0
    T_map_camera: str | None = None


@dataclass(frozen=True)
class CameraQuery:
    """Pixels; without them the session's colour camera, scaled where only a size is given."""

    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    width: int | None = None
    height: int | None = None


@dataclass(frozen=True)
class ViewQuery:
    """What is drawn (colour, depth, alpha, confidence), as what (jpeg, png, msgpack), when.

    Without a time it has the map's mean exposure.
    """

    what: str = "colour"
    format: str = "jpeg"
    appearance_t_ns: int | None = None


def map_routes(sessions: Sessions) -> APIRouter:
    """The routes of the map."""
    router = APIRouter()
    _add_render_route(router, sessions)
    _add_file_routes(router, sessions)
    return router


def _add_render_route(router: APIRouter, sessions: Sessions) -> None:
    config = sessions.fabric.config

    @router.get(
        "/v1/sessions/{name}/render",
        response_class=Response,
        responses=examples.binary(*MEDIA_TYPES.values()),
    )
    async def render(
        name: str,
        request: Request,
        pose: Annotated[PoseQuery, Depends()],
        camera: Annotated[CameraQuery, Depends()],
        wanted: Annotated[ViewQuery, Depends()],
    ) -> Response:
        """A view of the map as an image, and how well it is known (0 to 1) in X-Confidence.

        Its ETag is of the map that is shown. If-None-Match with it answers 304 for as long as the
        same view would come again: the map has not changed, or by a few steps of its
        optimisation only (render.max_iterations, render.max_age_s of the mapper).
        """
        session = await sessions.get(name)
        view = _view(session, pose, camera, wanted)
        view.check(config.limits.max_render_pixels)
        wanted_now = view.unless(request.headers.get("if-none-match", ""))
        reply = await ask_render(session, wanted_now, config)
        headers = {"ETag": view.etag(reply.state), "Cache-Control": "no-cache"}
        if reply.state == wanted_now.unless_state:
            return Response(status_code=304, headers=headers)
        # Encoding takes 10 ms and more; frames go on meanwhile.
        content = await asyncio.to_thread(view.encode, reply)
        headers["X-Confidence"] = f"{mean_confidence(reply):.3f}"
        return Response(content, 200, headers, MEDIA_TYPES[view.format])


def _add_file_routes(router: APIRouter, sessions: Sessions) -> None:
    responses = examples.binary("application/octet-stream")

    @router.get(
        "/v1/sessions/{name}/map.ply", response_class=StreamingResponse, responses=responses
    )
    async def get_ply(name: str) -> Response:
        """The map as 3D Gaussian splats, in the file format of splat viewers."""
        session = await sessions.get(name)
        return await _file(session, ExportFormat.PLY, sessions.fabric.config)

    @router.get("/v1/sessions/{name}/map", response_class=StreamingResponse, responses=responses)
    async def get_map(name: str, format: ExportFormat) -> Response:
        """The map as a file: splats, a mesh, points, or a snapshot to resume elsewhere."""
        return await _file(await sessions.get(name), format, sessions.fabric.config)


def _view(session: Session, pose: PoseQuery, camera: CameraQuery, wanted: ViewQuery) -> View:
    lens = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    colour = session.calibration.colour.intrinsics
    return View(
        request=RenderRequest(
            T_world_camera=pose_from(pose.T_map_camera, vars(pose)),
            intrinsics=intrinsics_from(lens, camera.width, camera.height, colour),
            appearance_t_ns=wanted.appearance_t_ns,
        ),
        what=wanted.what,
        format=wanted.format,
    )


async def _file(session: Session, format: ExportFormat, config: GatewayConfig) -> Response:
    pieces = export_pieces(session, format, config)
    first = await anext(pieces)  # an error here still becomes a status

    async def content() -> AsyncIterator[bytes]:
        yield first.bytes
        async for piece in pieces:
            yield piece.bytes

    name = f"{session.name}.{SUFFIXES[format]}"
    headers = {
        "Content-Length": str(first.total),
        "Content-Disposition": f'attachment; filename="{name}"',
    }
    return StreamingResponse(content(), 200, headers, "application/octet-stream")
