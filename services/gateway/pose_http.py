"""HTTP: the poses of a session as server-sent events."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Any

from fastapi import APIRouter
from starlette.responses import Response, StreamingResponse

from services.gateway import examples
from services.gateway.axes import Axes
from services.gateway.http import pose_json
from services.gateway.pose_watch import WatchedPose, follow, watched
from services.gateway.session import Session
from services.gateway.sessions import Sessions


def pose_routes(sessions: Sessions) -> APIRouter:
    """The route of pose events."""
    router = APIRouter()
    config = sessions.fabric.config.stream

    @router.get(
        "/v1/sessions/{name}/pose/events",
        response_class=StreamingResponse,
        responses=examples.POSE_EVENTS,
    )
    async def pose_events(name: str, frame: Axes = Axes.OPENCV) -> Response:
        """Server-sent events: `pose` for each answered frame, `correction` when the map moved it.

        Both carry `T_map_odom` for a device that sends its odometry: what a robot publishes as
        map -> odom (REP 105). `map_revision` grows with each change of the map.
        """
        session = await sessions.get(name)
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}

        async def events() -> AsyncIterator[str]:
            every_s = (config.event_interval_s, config.ping_interval_s)
            async for event in _events(session, frame, *every_s):
                if not sessions.is_serving(session):
                    return
                if event:
                    yield event

        return StreamingResponse(events(), 200, headers, "text/event-stream")

    return router


async def _events(
    session: Session, axes: Axes, look_every_s: float, ping_every_s: float
) -> AsyncIterator[str]:
    quiet_s = 0.0
    with watched(session) as queue:
        yield ": from here on no pose is missed\n\n"
        async for news in follow(session, queue, look_every_s):
            quiet_s = 0.0 if news else quiet_s + look_every_s
            if news is not None:
                yield _event(news, axes)
            else:  # a look that finds nothing is told too: the stream may have to end
                yield ": nothing new\n\n" if quiet_s >= ping_every_s else ""
                quiet_s = quiet_s % ping_every_s


def _event(news: WatchedPose, axes: Axes) -> str:
    name = "correction" if news.is_correction else "pose"
    content: dict[str, Any] = pose_json(news.pose, axes, news.T_map_odom)
    return f"event: {name}\ndata: {json.dumps(content)}\n\n"
