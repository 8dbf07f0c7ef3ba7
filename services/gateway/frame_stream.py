"""A stream of frames and their replies, in order, whatever carries it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from services.gateway.config import StreamConfig
from services.gateway.errors import detail
from services.gateway.frame_queue import Outcome
from services.gateway.session import Session
from shared.errors import PointSlamError
from shared.stream import FrameMessage, FrameReply

LOGGER = logging.getLogger(__name__)


class SlowClientError(Exception):
    """The client does not read its replies."""


class FrameStream:
    """One client's connection: a reader puts frames, a writer sends their replies in order."""

    def __init__(
        self,
        session: Session,
        config: StreamConfig,
        send: Callable[[FrameReply], Awaitable[None]],
    ) -> None:
        self._session = session
        self._send = send
        self._timeout_s = config.send_timeout_s
        self._room = asyncio.Semaphore(config.live_unanswered if session.is_live else config.credit)
        self._answers: asyncio.Queue[tuple[int, int, asyncio.Future[Outcome]] | None]
        self._answers = asyncio.Queue()
        self._has_claim = False  # taken once: a stream that loses the session does not fight for it

    async def run(self, read: Callable[[FrameStream], Awaitable[None]]) -> None:
        """Serve until `read`, which puts the frames, ends and they are answered.

        Raises:
            SlowClientError: the client did not read for too long.
        """
        writer = asyncio.create_task(self._write())
        reader = asyncio.create_task(self._read(read))
        try:
            with self._session.usage.held():
                await asyncio.wait({writer, reader}, return_when=asyncio.FIRST_COMPLETED)
            if not writer.done():
                reader.result()
            await writer
        finally:
            reader.cancel()
            writer.cancel()

    async def put(
        self, read: Callable[[], FrameMessage], numbers: Callable[[], tuple[int, int]]
    ) -> None:
        """Take one frame; waits while the client is beyond its credit.

        `numbers` tells `seq` and `t_ns` of a frame that `read` refuses, so that its reply has them.
        """
        await self._room.acquire()
        try:
            if not self._has_claim:
                await self._session.claim()
                self._has_claim = True
            message = read()
            seq, t_ns = message.seq, message.t_ns
            future = self._session.submit(message)
        except PointSlamError as error:
            seq, t_ns = numbers()
            future = asyncio.get_running_loop().create_future()
            future.set_result(error)
        self._answers.put_nowait((seq, t_ns, future))

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
                LOGGER.info("%s: cut off a client that does not read", self._session.name)
                raise SlowClientError from None
            self._room.release()
