"""The frame stream over WebSocket: binary msgpack frames in, replies out, in order."""

from __future__ import annotations

import asyncio
import logging

from fastapi import APIRouter
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.gateway.config import StreamConfig
from services.gateway.decode import read_frame
from services.gateway.errors import MESSAGE, detail
from services.gateway.frame_queue import Outcome
from services.gateway.problems import problem_response
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from shared import codec
from shared.errors import InputError, PointSlamError
from shared.stream import FrameReply

LOGGER = logging.getLogger(__name__)

_SLOW_CLIENT = 1008
_UNKNOWN = -1  # seq and t_ns of a reply to a message that could not be read


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
        await FrameStream(websocket, session, sessions.fabric.config.stream).run()

    return router


class FrameStream:
    """One client's connection: a reader, a writer, and the answers between them in order."""

    def __init__(self, websocket: WebSocket, session: Session, config: StreamConfig) -> None:
        self._websocket = websocket
        self._session = session
        self._config = config
        unanswered = config.live_unanswered if session.is_live else config.credit
        self._room = asyncio.Semaphore(unanswered)
        self._answers: asyncio.Queue[tuple[int, int, asyncio.Future[Outcome]]] = asyncio.Queue()

    async def run(self) -> None:
        """Serve until the client goes, or does not read for too long; the session goes on."""
        tasks = {asyncio.create_task(self._read()), asyncio.create_task(self._write())}
        done, pending = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in pending:
            task.cancel()
        await asyncio.wait(tasks)
        for task in done:
            task.result()

    async def _read(self) -> None:
        while True:
            message = await self._websocket.receive()
            if message["type"] == "websocket.disconnect":
                return
            # A client that sends beyond its credit is read no further: TCP holds it back.
            await self._room.acquire()
            self._submit(message.get("bytes"))

    def _submit(self, data: bytes | None) -> None:
        seq = t_ns = _UNKNOWN
        try:
            if data is None:
                raise InputError(MESSAGE, "must be a binary message")
            message = read_frame(data, self._session.calibration)
            seq, t_ns = message.seq, message.t_ns
            future = self._session.submit(message)
        except PointSlamError as error:
            future = asyncio.get_running_loop().create_future()
            future.set_result(error)
        self._answers.put_nowait((seq, t_ns, future))

    async def _write(self) -> None:
        while True:
            seq, t_ns, future = await self._answers.get()
            outcome = await asyncio.shield(future)
            if isinstance(outcome, PointSlamError):
                outcome = FrameReply(seq, t_ns, error=detail(outcome))
            try:
                async with asyncio.timeout(self._config.send_timeout_s):
                    await self._websocket.send_bytes(codec.pack(outcome))
            except TimeoutError:
                LOGGER.info("%s: cut off a client that does not read", self._session.name)
                await self._cut()
                return
            except WebSocketDisconnect:
                return
            self._room.release()

    async def _cut(self) -> None:
        try:
            async with asyncio.timeout(0.5):
                await self._websocket.close(_SLOW_CLIENT, "replies are not read")
        except (TimeoutError, RuntimeError, WebSocketDisconnect):
            return  # it does not read the closing either
