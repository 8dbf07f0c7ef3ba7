"""The gRPC service of frames: those that advance a session, those that watch it, single images."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any

import grpc

from services.gateway.access.caller import current_caller
from services.gateway.decode import UNKNOWN, check_frame
from services.gateway.frame_stream import (
    ENDING,
    EndingError,
    FrameSink,
    FrameStream,
    SessionFrames,
    SlowClientError,
)
from services.gateway.grpc_errors import refusing
from services.gateway.localizer import check_localize
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from services.gateway.wire_values import (
    calibration_from,
    frame_from,
    localize_from,
    localized_to,
    reply_to,
    require,
)
from shared.camera import Calibration
from shared.errors import InputError
from shared.stream import FrameMessage, FrameReply
from shared.wire import tracking_service_pb2, tracking_service_pb2_grpc

Send = Callable[[FrameReply], Awaitable[None]]
Read = Callable[[FrameStream], Awaitable[None]]


class TrackingService(tracking_service_pb2_grpc.TrackingServiceServicer):
    """Frames in, poses out."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions

    async def TrackFrames(self, request_iterator: Any, context: Any) -> None:
        """Answer a stream of frames in order."""

        async def send(reply: FrameReply) -> None:
            await context.write(reply_to(reply))

        async with refusing(context):
            requests = aiter(request_iterator)
            if (first := await anext(requests, None)) is None:
                return
            session = await self._sessions.get(first.session_id)
            frames = _Frames(session, session.calibration, _traceparent(context))
            sink = SessionFrames(session)
            await self._serve(sink, send, frames.reader(first, requests), context)

    async def WatchFrames(self, request_iterator: Any, context: Any) -> None:
        """Follow a camera in the map of a session."""

        async def send(reply: FrameReply) -> None:
            await context.write(tracking_service_pb2.WatchFramesResponse(reply=reply_to(reply)))

        async with refusing(context):
            requests = aiter(request_iterator)
            if (first := await anext(requests, None)) is None:
                return
            session = await self._sessions.get(first.session_id)
            with session.watchers.joined(session.usage) as watcher:
                if first.HasField("calibration"):
                    watcher.calibration = calibration_from(first.calibration)
                    watcher.calibration.check()
                frames = _Frames(session, watcher.calibration, _traceparent(context))
                await self._serve(watcher, send, frames.reader(first, requests), context)

    async def Localize(self, request: Any, context: Any) -> Any:
        """Find one image in a session's map."""
        async with refusing(context):
            session = await self._sessions.get(request.session_id)
            message = localize_from(request)
            check_localize(message, session.calibration)
            return localized_to(await session.localize(message))

    async def _serve(self, sink: FrameSink, send: Send, read: Read, context: Any) -> None:
        fabric = self._sessions.fabric
        with fabric.streams.joined():
            try:
                await FrameStream(sink, fabric, send).run(read)
            except SlowClientError:
                await context.abort(grpc.StatusCode.DEADLINE_EXCEEDED, "replies are not read")
            except EndingError:
                await context.abort(grpc.StatusCode.UNAVAILABLE, ENDING)


@dataclass(frozen=True)
class _Frames:
    """The frames in the messages of one call."""

    session: Session
    calibration: Calibration
    traceparent: str

    def reader(self, first: Any, requests: AsyncIterator[Any]) -> Read:
        """Puts the first message and those that follow into a stream."""

        async def read(frames: FrameStream) -> None:
            await frames.put(lambda: self._frame(first), lambda: _numbers(first))
            async for request in requests:
                await frames.put(
                    lambda request=request: self._frame(request),
                    lambda request=request: _numbers(request),
                )

        return read

    def _frame(self, request: Any) -> FrameMessage:
        current_caller().budget.take_frame()
        if request.session_id not in ("", self.session.name):
            raise InputError("session_id", f"this stream is of session {self.session.name}")
        message = replace(frame_from(require(request, "frame")), traceparent=self.traceparent)
        check_frame(message, self.calibration)
        return message


def _numbers(request: Any) -> tuple[int, int]:
    if not request.HasField("frame"):
        return UNKNOWN, UNKNOWN
    return request.frame.seq, request.frame.t_ns


def _traceparent(context: Any) -> str:
    return dict(context.invocation_metadata()).get("traceparent", "")
