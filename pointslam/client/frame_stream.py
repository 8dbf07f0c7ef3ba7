"""The frame stream over a synchronous WebSocket: a thread sends, the caller reads."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

import httpx
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from pointslam.client.calls import error_from, problem_of
from shared import codec
from shared.errors import UnavailableError
from shared.stream import ErrorDetail, FrameMessage, FrameReply

_MAX_REPLY_BYTES = 1 << 20


@dataclass(frozen=True)
class StreamTarget:
    """Where frames go: a socket, its headers, and what it is told before the first frame."""

    url: str
    headers: Mapping[str, str] = field(default_factory=dict)
    greeting: str | None = None


def stream_frames(
    target: StreamTarget, frames: Iterable[FrameMessage], credit: int | None
) -> Iterator[FrameReply]:
    """Send frames and yield replies; without credit each frame is sent as soon as it is there.

    Raises:
        PointSlamError: the gateway refused the stream, or the connection broke.
        Exception: what `frames` raised.
    """
    with open_stream(target.url, target.headers) as connection:
        if target.greeting is not None:
            connection.send(target.greeting)
        sender = _Sender(connection, frames, credit)
        sender.start()
        try:
            while sender.expects_reply():
                reply = codec.unpack(FrameReply, _receive(connection))
                sender.replied(reply.credit)
                yield reply
        finally:
            sender.stop()
        if sender.failure is not None:
            raise sender.failure


@contextmanager
def open_stream(url: str, headers: Mapping[str, str] | None = None) -> Iterator[ClientConnection]:
    """A connection for frames: no compression, which costs far more than it saves on images.

    Raises:
        PointSlamError: the gateway refused it.
        UnavailableError: it does not answer.
    """
    with ExitStack() as stack:
        try:
            connection = stack.enter_context(
                connect(
                    url,
                    additional_headers=headers,
                    compression=None,
                    max_size=_MAX_REPLY_BYTES,
                    ping_timeout=120,
                )
            )
        except InvalidStatus as error:
            raise error_from(refusal(error)) from None
        except (OSError, TimeoutError) as error:
            raise UnavailableError(f"{url} does not answer ({error})") from None
        yield connection


def refusal(error: InvalidStatus) -> ErrorDetail:
    """What the gateway said when it refused a WebSocket."""
    response = error.response
    return problem_of(httpx.Response(response.status_code, content=bytes(response.body or b"")))


def _receive(connection: ClientConnection) -> bytes:
    try:
        data = connection.recv()
    except ConnectionClosed as error:
        raise UnavailableError(f"the frame stream broke: {error}") from None
    return data if isinstance(data, bytes) else data.encode()


class _Sender(threading.Thread):
    """Sends frames as far as credit goes; keeps what `frames` raised."""

    def __init__(
        self, connection: ClientConnection, frames: Iterable[FrameMessage], credit: int | None
    ) -> None:
        super().__init__(name="frame-sender", daemon=True)
        self.failure: BaseException | None = None
        self._connection = connection
        self._frames = frames
        self._credit = None if credit is None else threading.Semaphore(credit)
        self._changed = threading.Condition()
        self._unanswered = 0
        self._is_done = False

    def run(self) -> None:
        try:
            for frame in self._frames:
                if not self._send(frame):
                    break
        except ConnectionClosed:
            pass  # the reader tells
        except BaseException as error:
            self.failure = error
        with self._changed:
            self._is_done = True
            self._changed.notify_all()

    def expects_reply(self) -> bool:
        """Wait until a reply is due; false when everything sent has been answered."""
        with self._changed:
            self._changed.wait_for(lambda: self._unanswered or self._is_done)
            return self._unanswered > 0

    def replied(self, credit: int) -> None:
        """Count a reply and the credit that came with it."""
        with self._changed:
            self._unanswered -= 1
        if self._credit is not None and credit > 0:
            self._credit.release(credit)

    def stop(self) -> None:
        """Send nothing more."""
        with self._changed:
            self._is_done = True
        if self._credit is not None:
            self._credit.release()
        self._connection.close()
        self.join(timeout=10.0)

    def _send(self, frame: FrameMessage) -> bool:
        data = codec.pack(frame)
        if self._credit is not None:
            self._credit.acquire()
        with self._changed:
            if self._is_done:
                return False
            self._unanswered += 1
            self._changed.notify_all()
        self._connection.send(data)
        return True
