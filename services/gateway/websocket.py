"""The frame streams over WebSocket: binary msgpack frames in, replies out, in order."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass

from fastapi import APIRouter
from starlette.types import Message
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.gateway.access.caller import current_caller
from services.gateway.decode import plain, read_frame, read_numbers
from services.gateway.errors import MESSAGE
from services.gateway.frame_stream import (
    ENDING,
    EndingError,
    FrameSink,
    FrameStream,
    SessionFrames,
    SlowClientError,
)
from services.gateway.owner import Fabric
from services.gateway.problems import problem_response
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from services.gateway.watcher import Watcher
from shared import codec
from shared.camera import Calibration
from shared.errors import InputError, PointSlamError
from shared.stream import FrameMessage, FrameReply

_POLICY_VIOLATION = 1008
_SERVICE_RESTART = 1012
_MAX_TEXT = 4096  # characters of a calibration


@dataclass(frozen=True)
class WatcherDevice:
    """What a watcher may say before its frames."""

    calibration: Calibration


def websocket_routes(sessions: Sessions) -> APIRouter:
    """The routes of those who advance a session and of those who watch it."""
    router = APIRouter()

    @router.websocket("/v1/sessions/{name}/stream")
    async def stream(websocket: WebSocket, name: str) -> None:
        if (session := await _accepted(websocket, name, sessions)) is not None:
            door = _Door(websocket, SessionFrames(session), session.calibration)
            await door.serve(sessions.fabric)

    @router.websocket("/v1/sessions/{name}/watch")
    async def watch(websocket: WebSocket, name: str) -> None:
        if (session := await _accepted(websocket, name, sessions)) is not None:
            with session.watchers.joined(session.usage) as watcher:
                door = _WatchersDoor(websocket, watcher, watcher.calibration)
                await door.serve(sessions.fabric)

    return router


async def _accepted(websocket: WebSocket, name: str, sessions: Sessions) -> Session | None:
    try:
        session = await sessions.get(name)
    except PointSlamError as error:
        await websocket.send_denial_response(problem_response(error))
        return None
    await websocket.accept()
    return session


class _Door:
    """One client's socket: each of its messages is a frame."""

    def __init__(self, websocket: WebSocket, sink: FrameSink, calibration: Calibration) -> None:
        self._websocket = websocket
        self._sink = sink
        self.calibration = calibration

    async def serve(self, fabric: Fabric) -> None:
        """Until the client goes, or does not read, or this gateway ends."""
        with fabric.streams.joined():
            try:
                await FrameStream(self._sink, fabric, self._send).run(self._read)
            except WebSocketDisconnect:
                return
            except SlowClientError:
                await _close(self._websocket, _POLICY_VIOLATION, "replies are not read")
            except EndingError:
                await _close(self._websocket, _SERVICE_RESTART, ENDING)

    async def _read(self, frames: FrameStream) -> None:
        while (message := await self._websocket.receive())["type"] != "websocket.disconnect":
            await self.take(message, frames)

    async def take(self, message: Message, frames: FrameStream) -> None:
        """Pass one message on."""
        data = message.get("bytes")
        await frames.put(lambda: self._frame(data), lambda: read_numbers(data or b""))

    async def _send(self, reply: FrameReply) -> None:
        await self._websocket.send_bytes(codec.pack(reply))

    def _frame(self, data: bytes | None) -> FrameMessage:
        current_caller().budget.take_frame()
        if data is None:
            raise InputError(MESSAGE, "must be a binary message")
        return read_frame(data, self.calibration)


class _WatchersDoor(_Door):
    """The same for one who watches; a text says which device it has, if not the session's."""

    def __init__(self, websocket: WebSocket, sink: Watcher, calibration: Calibration) -> None:
        super().__init__(websocket, sink, calibration)
        self._watcher = sink

    async def take(self, message: Message, frames: FrameStream) -> None:
        """Pass one frame on, or note the device."""
        text = message.get("text")
        if text is None:
            await super().take(message, frames)
            return
        try:
            self.calibration = self._watcher.calibration = _device(text)
        except InputError as error:
            await frames.refuse(error)


def _device(text: str) -> Calibration:
    """The calibration that a watcher sends before its frames, as in `POST /v1/sessions`."""
    try:
        if len(text) > _MAX_TEXT:
            raise ValueError(f"longer than {_MAX_TEXT} characters")
        device = plain(WatcherDevice, json.loads(text))
    except (ValueError, RecursionError) as error:
        raise InputError(MESSAGE, f"not a device as JSON ({str(error)[:100]})") from None
    device.calibration.check()
    return device.calibration


async def _close(websocket: WebSocket, code: int, reason: str) -> None:
    try:
        async with asyncio.timeout(0.5):
            await websocket.close(code, reason)
    except (TimeoutError, WebSocketDisconnect):
        return  # it does not read the closing either
