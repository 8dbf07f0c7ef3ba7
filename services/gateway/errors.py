"""The one place that turns errors into what a client sees: problem+json and gRPC status."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

import grpc

from shared.errors import (
    ConflictError,
    ForbiddenError,
    InputError,
    NotFoundError,
    PointSlamError,
    RateLimitedError,
    StorageError,
    UnauthenticatedError,
    UnavailableError,
)
from shared.stream import ErrorDetail

MESSAGE = "message"  # the field of an error in a message as a whole


class TooLargeError(InputError):
    """A body or message is over the limit."""

    code = "too_large"


class OrderError(InputError):
    """A frame repeats an earlier one or comes before it; names `seq` or `t_ns`."""

    code = ConflictError.code


_HTTP: tuple[tuple[type[PointSlamError], int], ...] = (
    (TooLargeError, 413),
    (OrderError, 409),
    (InputError, 422),
    (UnauthenticatedError, 401),
    (ForbiddenError, 403),
    (RateLimitedError, 429),
    (NotFoundError, 404),
    (ConflictError, 409),
    (UnavailableError, 503),
    (StorageError, 507),
)

_GRPC: tuple[tuple[type[PointSlamError], grpc.StatusCode], ...] = (
    (TooLargeError, grpc.StatusCode.RESOURCE_EXHAUSTED),
    (OrderError, grpc.StatusCode.FAILED_PRECONDITION),
    (InputError, grpc.StatusCode.INVALID_ARGUMENT),
    (UnauthenticatedError, grpc.StatusCode.UNAUTHENTICATED),
    (ForbiddenError, grpc.StatusCode.PERMISSION_DENIED),
    (RateLimitedError, grpc.StatusCode.RESOURCE_EXHAUSTED),
    (NotFoundError, grpc.StatusCode.NOT_FOUND),
    (ConflictError, grpc.StatusCode.FAILED_PRECONDITION),
    (UnavailableError, grpc.StatusCode.UNAVAILABLE),
    (StorageError, grpc.StatusCode.RESOURCE_EXHAUSTED),
)


def detail(error: PointSlamError) -> ErrorDetail:
    """Code, field and reason of an error, as a frame's reply carries them."""
    if isinstance(error, InputError):
        return ErrorDetail(error.code, error.field, error.reason)
    return ErrorDetail(error.code, "", str(error))


def http_status(error: PointSlamError) -> int:
    """The HTTP status of an error."""
    if isinstance(error, InputError) and error.field == MESSAGE and error.code == InputError.code:
        return 400
    return next((status for kind, status in _HTTP if isinstance(error, kind)), 500)


def grpc_status(error: PointSlamError) -> grpc.StatusCode:
    """The gRPC status of an error."""
    return next((s for kind, s in _GRPC if isinstance(error, kind)), grpc.StatusCode.INTERNAL)


def problem(status: int, what: ErrorDetail) -> dict[str, Any]:
    """A problem document (RFC 9457) with our code and the field at fault as extensions."""
    document: dict[str, Any] = {
        "type": f"urn:pointslam:error:{what.code}",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": f"{what.field}: {what.reason}" if what.field else what.reason,
        "code": what.code,
        "reason": what.reason,
    }
    if what.field:
        document["field"] = what.field
    return document
