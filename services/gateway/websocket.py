"""The frame stream over WebSocket: binary msgpack frames in, replies out, in order."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.gateway.access.caller import current_caller
from services.gateway.decode import read_frame, read_numbers
from services.gateway.errors import MESSAGE
from services.gateway.frame_stream import FrameStream, SlowClientError
from services.gateway.problems import problem_response
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from shared import codec
from shared.errors import InputError, PointSlamError
from shared.stream import FrameMessage, FrameReply

_POLICY_VIOLATION = 1008


def websocket_routes(sessions: Sessions) -> APIRouter:
    """The frame stream's route."""
    router = APIRouter()

    @router.websocket("/v1/sessions/{name}/stream")
    async def stream(websocket: WebSocket, name: str) -> None:
        try:
            session = await sessions.get(name)
        except PointSlamError as error:
            await websocket.send_denial_response(problem_response(error))
            return
        await websocket.accept()
        await _serve(websocket, session, sessions)

    return router


async def _serve(websocket: WebSocket, session: Session, sessions: Sessions) -> None:
    async def read(frames: FrameStream) -> None:
        while (message := await websocket.receive())["type"] != "websocket.disconnect":
            data = message.get("bytes")
            await frames.put(
                lambda data=data: _frame(data, session),
                lambda data=data: read_numbers(data or b""),
            )

    async def send(reply: FrameReply) -> None:
        await websocket.send_bytes(codec.pack(reply))

    try:
        await FrameStream(session, sessions.fabric.config.stream, send).run(read)
    except WebSocketDisconnect:
        return
    except SlowClientError:
        await _cut(websocket)


def _frame(data: bytes | None, session: Session) -> FrameMessage:
    current_caller().budget.take_frame()
    if data is None:
        raise InputError(MESSAGE, "must be a binary message")
    return read_frame(data, session.calibration)


async def _cut(websocket: WebSocket) -> None:
    try:
        async with asyncio.timeout(0.5):
            await websocket.close(_POLICY_VIOLATION, "replies are not read")
    except (TimeoutError, WebSocketDisconnect):
        return  # it does not read the closing either
