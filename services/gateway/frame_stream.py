"""A stream of frames and their replies, in order, whatever carries it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Protocol

from services.gateway.decode import UNKNOWN
from services.gateway.errors import detail
from services.gateway.frame_queue import Outcome
from services.gateway.owner import Fabric
from services.gateway.session import Session
from services.gateway.usage import Usage
from shared.errors import PointSlamError
from shared.stream import FrameMessage, FrameReply

LOGGER = logging.getLogger(__name__)
ENDING = "this gateway is ending: connect again"


class SlowClientError(Exception):
    """The client does not read its replies."""


class EndingError(Exception):
    """This gateway is ending: every frame that it took is answered, and no more are taken."""


class FrameSink(Protocol):
    """Where the frames of a stream go."""

    name: str
    is_live: bool
    usage: Usage

    async def begin(self) -> None:
        """Before the first frame."""
        ...

    def submit(self, message: FrameMessage) -> asyncio.Future[Outcome]:
        """Queue a checked frame; its answer comes in the future."""
        ...


class SessionFrames:
    """A stream that advances a session, until a newer one does; a `FrameSink`."""

    def __init__(self, session: Session) -> None:
        self.name = session.name
        self.is_live = session.is_live
        self.usage = session.usage
        self._session = session

    async def begin(self) -> None:
        """Take the session over from whoever advances it."""
        await self._session.begin_stream(self)

    def submit(self, message: FrameMessage) -> asyncio.Future[Outcome]:
        """Queue a checked frame; raises ClaimLostError where a newer stream has begun."""
        return self._session.submit(message, self)


class FrameStream:
    """One client's connection: a reader puts frames, a writer sends their replies in order."""

    def __init__(
        self,
        sink: FrameSink,
        fabric: Fabric,
        send: Callable[[FrameReply], Awaitable[None]],
    ) -> None:
        self._sink = sink
        self._send = send
        config = fabric.config.stream
        self._ending = fabric.streams.ending
        self._timeout_s = config.send_timeout_s
        self._room = asyncio.Semaphore(config.live_unanswered if sink.is_live else config.credit)
        self._answers: asyncio.Queue[tuple[int, int, asyncio.Future[Outcome]] | None]
        self._answers = asyncio.Queue()
        self._has_begun = False  # once: a stream that loses the session does not fight for it

    async def run(self, read: Callable[[FrameStream], Awaitable[None]]) -> None:
        """Serve until `read`, which puts the frames, ends and they are answered.

        Raises:
            SlowClientError: the client did not read for too long.
            EndingError: the gateway ends before the client does.
        """
        writer = asyncio.create_task(self._write())
        reader = asyncio.create_task(self._read(read))
        ending = asyncio.create_task(self._ending.wait())
        try:
            with self._sink.usage.held():
                await asyncio.wait({writer, reader, ending}, return_when=asyncio.FIRST_COMPLETED)
            if not (writer.done() or reader.done()):
                await self._finish(reader, writer)
            if not writer.done():
                reader.result()
            await writer
        finally:
            for task in (reader, writer, ending):
                task.cancel()

    async def put(
        self, read: Callable[[], FrameMessage], numbers: Callable[[], tuple[int, int]]
    ) -> None:
        """Take one frame; waits while the client is beyond its credit.

        `numbers` tells `seq` and `t_ns` of a frame that `read` refuses, so that its reply has them.
        """
        await self._room.acquire()
        try:
            if not self._has_begun:
                await self._sink.begin()
                self._has_begun = True
            message = read()
            seq, t_ns = message.seq, message.t_ns
            future = self._sink.submit(message)
        except PointSlamError as error:
            seq, t_ns = numbers()
            future = asyncio.get_running_loop().create_future()
            future.set_result(error)
        self._answers.put_nowait((seq, t_ns, future))

    async def refuse(self, error: PointSlamError) -> None:
        """Answer a message that is no frame."""

        def fail() -> FrameMessage:
            raise error

        await self.put(fail, lambda: (UNKNOWN, UNKNOWN))

    async def _finish(self, reader: asyncio.Task[None], writer: asyncio.Task[None]) -> None:
        reader.cancel()
        await asyncio.wait({reader})  # what it was about to put is not taken
        self._answers.put_nowait(None)
        await writer
        raise EndingError

    async def _read(self, read: Callable[[FrameStream], Awaitable[None]]) -> None:
        await read(self)
        self._answers.put_nowait(None)

    async def _write(self) -> None:
        while (answer := await self._answers.get()) is not None:
            seq, t_ns, future = answer
            outcome = await asyncio.shield(future)
            if isinstance(outcome, PointSlamError):
                outcome = FrameReply(seq, t_ns, error=detail(outcome))
            try:
                async with asyncio.timeout(self._timeout_s):
                    await self._send(outcome)
            except TimeoutError:
                LOGGER.info("%s: cut off a client that does not read", self._sink.name)
                raise SlowClientError from None
            self._room.release()
