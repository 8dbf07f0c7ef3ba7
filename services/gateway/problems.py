"""Every error of the HTTP side as problem+json."""

from __future__ import annotations

import math

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response

from services.gateway.errors import detail, http_status, problem
from shared.errors import (
    InputError,
    NotFoundError,
    PointSlamError,
    RateLimitedError,
    UnauthenticatedError,
    UnavailableError,
)
from shared.stream import ErrorDetail

MEDIA_TYPE = "application/problem+json"
_RETRY_AFTER_S = "1"


def problem_response(error: PointSlamError) -> Response:
    """The response to a request that failed with one of our errors."""
    status = http_status(error)
    return JSONResponse(problem(status, detail(error)), status, _headers(error), MEDIA_TYPE)


def _headers(error: PointSlamError) -> dict[str, str]:
    if isinstance(error, UnauthenticatedError):
        return {"WWW-Authenticate": "Bearer"}
    if isinstance(error, RateLimitedError):
        return {"Retry-After": str(math.ceil(error.retry_after_s))}
    return {"Retry-After": _RETRY_AFTER_S} if isinstance(error, UnavailableError) else {}


def add_handlers(app: FastAPI) -> None:
    """Translate our errors, the framework's own, and a client that went away."""

    @app.exception_handler(PointSlamError)
    async def _ours(_: Request, error: PointSlamError) -> Response:
        return problem_response(error)

    @app.exception_handler(RequestValidationError)
    async def _validation(_: Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"][1:]) or "body"
        return problem_response(InputError(field, str(first["msg"])))

    @app.exception_handler(HTTPException)
    async def _http(_: Request, error: HTTPException) -> Response:
        code = NotFoundError.code if error.status_code == 404 else "error"
        document = problem(error.status_code, ErrorDetail(code, "", str(error.detail)))
        return JSONResponse(document, error.status_code, error.headers, MEDIA_TYPE)

    @app.exception_handler(Exception)
    async def _fault(_: Request, __: Exception) -> Response:
        return problem_response(PointSlamError("internal error; see the gateway's log"))

    @app.exception_handler(ClientDisconnect)
    async def _gone(_: Request, __: ClientDisconnect) -> Response:
        return Response(status_code=499)  # nobody reads it
