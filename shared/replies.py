"""How an answer crosses the bus: a message, or an error of ours."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import zenoh

from shared import codec
from shared.errors import (
    ClaimLostError,
    ConfigError,
    ConflictError,
    GoneError,
    InputError,
    NotFoundError,
    PointSlamError,
    SteppedDownError,
    StorageError,
    TimedOutError,
    UnavailableError,
)
from shared.keys import Keys
from shared.tracing import log_fields, span

_MAX_ATTACHMENT = 200  # a traceparent has 55 bytes
LOGGER = logging.getLogger(__name__)

_ERRORS: dict[str, type[PointSlamError]] = {
    kind.code: kind
    for kind in (
        ClaimLostError,
        ConfigError,
        ConflictError,
        NotFoundError,
        StorageError,
        UnavailableError,
    )
}


@dataclass(frozen=True)
class _Failure:
    code: str
    text: str
    field: str = ""


def read_reply(reply: zenoh.Reply, key: str, kind: type) -> Any:
    """The message in a reply, or the error that the other side raised, rebuilt and raised here."""
    if reply.ok is not None:
        return codec.unpack(kind, reply.ok.payload.to_bytes())
    assert reply.err is not None
    payload = reply.err.payload.to_bytes()
    if payload == b"Timeout":
        raise TimedOutError(f"no answer in time from {key}")
    try:
        failure = codec.unpack(_Failure, payload)
    except InputError:
        raise UnavailableError(f"{key}: {payload[:200]!r}") from None
    if failure.code == InputError.code:
        raise InputError(failure.field, failure.text)
    raise _ERRORS.get(failure.code, PointSlamError)(failure.text)


def settle(answered: asyncio.Future[Any], replies: list[zenoh.Reply], key: str, kind: type) -> None:
    """Give who waits the message or the error of the first reply; GoneError without any."""
    try:
        if not replies:
            raise GoneError(f"nobody answers {key}")
        answered.set_result(read_reply(replies[0], key, kind))
    except Exception as error:  # whatever it is, it is for who waits
        answered.set_exception(error)


@contextmanager
def _answering(key: str, traceparent: str) -> Iterator[None]:
    if not traceparent:
        yield
        return
    _, _, about, *_, question = key.split("/")
    with span(f"{about} {question}", traceparent):
        yield


def answer_query(query: zenoh.Query, key: str, kind: type, answer: Callable[[Any], object]) -> None:
    """Reply to a query with what `answer` returns or raises; always finishes the query.

    Log lines say whose map it is about, and a query of a trace is answered in a span of its own.
    """
    attached = query.attachment
    traceparent = attached.to_bytes()[:_MAX_ATTACHMENT].decode(errors="replace") if attached else ""
    with query, log_fields(**Keys.fields(key)), _answering(key, traceparent):
        try:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            query.reply(key, codec.pack(answer(codec.unpack(kind, payload))))
        except SteppedDownError as error:
            # No reply at all: the sender then looks for whoever answers now.
            LOGGER.warning("%s: not answered: %s", key, error)
        except InputError as error:
            query.reply_err(codec.pack(_Failure(error.code, error.reason, error.field)))
        except PointSlamError as error:
            query.reply_err(codec.pack(_Failure(error.code, str(error))))
        except Exception:
            LOGGER.exception("%s: the answer failed", key)
            query.reply_err(codec.pack(_Failure("error", "internal error; see the service's log")))
