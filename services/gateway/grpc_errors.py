"""Errors of ours as the status of a gRPC call."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from services.gateway.errors import detail, grpc_status
from shared.errors import PointSlamError, RateLimitedError


@asynccontextmanager
async def refusing(context: Any) -> AsyncIterator[None]:
    """Turn an error of ours into the call's status; code and field go as trailing metadata."""
    try:
        yield
    except PointSlamError as error:
        what = detail(error)
        metadata = [("pointslam-code", what.code), ("pointslam-field", what.field)]
        if isinstance(error, RateLimitedError):
            metadata.append(("retry-after", f"{error.retry_after_s:.2f}"))
        await context.abort(grpc_status(error), str(error), tuple(metadata))
