"""HTTP for those who watch a session: its newest image, its path, its keyframes, its events."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Request
from starlette.responses import Response, StreamingResponse

from services.gateway import examples
from services.gateway.http import pose_json
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from services.gateway.trajectory import path_json
from shared import codec
from shared.errors import NotFoundError
from shared.maps import KeyframeReply, KeyframeRequest, Trajectory, TrajectoryRequest
from shared.se3 import Pose

_JPEG = "image/jpeg"


def live_routes(sessions: Sessions) -> APIRouter:
    """The routes of those who watch."""
    router = APIRouter()
    _add_image_routes(router, sessions)
    _add_path_routes(router, sessions)
    _add_event_route(router, sessions)
    return router


def _add_image_routes(router: APIRouter, sessions: Sessions) -> None:
    timeout_s = sessions.fabric.config.mapping.question_timeout_s
    responses = examples.binary(_JPEG)

    @router.get("/v1/sessions/{name}/image", response_class=Response, responses=responses)
    async def image(name: str, request: Request) -> Response:
        """The newest colour image, at most 480 px wide; 304 where If-None-Match has it.

        204 where no frame has come since this gateway serves the session.
        """
        newest = await (await sessions.get(name)).live.image.small()
        if newest is None:
            return Response(status_code=204)
        headers = {"ETag": f'"{newest.seq}"', "Cache-Control": "no-cache"}
        if headers["ETag"] in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return Response(newest.jpeg, 200, headers, _JPEG)

    @router.get(
        "/v1/sessions/{name}/keyframes/{seq}/image", response_class=Response, responses=responses
    )
    async def keyframe_image(name: str, seq: Annotated[int, Path(ge=0, lt=1 << 63)]) -> Response:
        """What a keyframe's camera saw, without lens distortion; its time is in X-Time-Ns."""
        owner = (await sessions.get(name)).owner
        reply: KeyframeReply = await owner.ask(
            "keyframe", KeyframeRequest(seq), KeyframeReply, timeout_s
        )
        headers = {"X-Time-Ns": str(reply.t_ns), "Cache-Control": "private, max-age=86400"}
        return Response(reply.rgb.bytes, 200, headers, _JPEG)


def _add_path_routes(router: APIRouter, sessions: Sessions) -> None:
    timeout_s = sessions.fabric.config.mapping.question_timeout_s

    @router.get("/v1/sessions/{name}/keyframes")
    async def keyframes(name: str) -> dict[str, Any]:
        """The keyframes with their present poses."""
        poses = (await sessions.get(name)).owner.keyframes
        rows = [
            {"seq": seq, "T_map_camera": codec.to_json(Pose.from_matrix(T))}
            for seq, T in zip(poses.seqs.tolist(), poses.T_world_keyframes, strict=True)
        ]
        return {"map_revision": poses.revision, "loops": poses.loops, "keyframes": rows}

    @router.get("/v1/sessions/{name}/path")
    async def path(
        name: str, max_points: Annotated[int, Query(ge=2, le=100_000)] = 2000
    ) -> dict[str, Any]:
        """Where the camera was, in the map as it is now: runs of positions [x, y, z], metres.

        A run ends where the camera was lost; a long path is thinned out to `max_points`.
        """
        owner = (await sessions.get(name)).owner
        trajectory = await owner.ask("trajectory", TrajectoryRequest(), Trajectory, timeout_s)
        return await asyncio.to_thread(path_json, trajectory, max_points)


def _add_event_route(router: APIRouter, sessions: Sessions) -> None:
    @router.get("/v1/sessions/{name}/events", response_class=StreamingResponse)
    async def events(name: str, last_event_id: Annotated[int, Header()] = 0) -> Response:
        """Server-sent events while the session is watched.

        `pose` is the newest answered frame with how well it is tracked, `map` the revision with
        the number of keyframes and loops; both come when they change, at most ten times a second.
        `lost`, `relocalized`, `loop_closed`, `owner_changed` and `saved` have an id and come once
        each, those of before too.
        """
        session = await sessions.get(name)
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        content = _LiveEvents(session, sessions, last_event_id).stream()
        return StreamingResponse(content, 200, headers, "text/event-stream")


class _LiveEvents:
    """One watcher: what it was told last, and what is new to it."""

    def __init__(self, session: Session, sessions: Sessions, last_event: int) -> None:
        self._session = session
        self._sessions = sessions
        self._stream = sessions.fabric.config.stream
        self._last_event = last_event
        self._told: dict[str, Any] = {}

    async def stream(self) -> AsyncIterator[str]:
        """Text of events for as long as the session is served here."""
        with self._session.usage.held():
            async for text in self._texts():
                yield text

    async def _texts(self) -> AsyncIterator[str]:
        quiet_s = 0.0
        yield "retry: 1000\n\n"
        while self._sessions.is_serving(self._session):
            text = "".join(self._news())
            quiet_s = 0.0 if text else quiet_s + self._stream.live_interval_s
            if quiet_s >= self._stream.ping_interval_s:
                quiet_s, text = 0.0, ": nothing new\n\n"
            if text:
                yield text
            await asyncio.sleep(self._stream.live_interval_s)

    def _news(self) -> list[str]:
        news = [_text(kind, what) for kind, what in self._states() if self._is_new(kind, what)]
        for event in self._session.live.events.after(self._last_event):
            self._last_event = event.number
            what = {"time_s": event.time_s, **event.details}
            news.append(_text(str(event.kind), what, event.number))
        return news

    def _states(self) -> list[tuple[str, dict[str, Any]]]:
        keyframes = self._session.owner.keyframes
        states = [
            (
                "map",
                {
                    "map_revision": keyframes.revision,
                    "keyframes": len(keyframes.seqs),
                    "loops": keyframes.loops,
                },
            )
        ]
        try:
            pose = pose_json(self._session.pose())
        except NotFoundError:
            return states
        return [("pose", pose | {"tracking": self._session.live.pulse.state()}), *states]

    def _is_new(self, kind: str, what: dict[str, Any]) -> bool:
        is_new = self._told.get(kind) != what
        self._told[kind] = what
        return is_new


def _text(kind: str, what: dict[str, Any], number: int | None = None) -> str:
    number_line = f"id: {number}\n" if number is not None else ""
    return f"{number_line}event: {kind}\ndata: {json.dumps(what)}\n\n"
