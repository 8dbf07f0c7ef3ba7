"""A limit on HTTP bodies, which neither uvicorn nor FastAPI has."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.gateway.errors import TooLargeError


class BodyLimit:
    """ASGI middleware that refuses longer bodies, by their header or while they come."""

    def __init__(self, app: ASGIApp, max_bytes: int) -> None:
        self._app = app
        self._max_bytes = max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on with a counting `receive`."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        declared = dict(scope["headers"]).get(b"content-length", b"0")
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if max(received, int(declared) if declared.isdigit() else 0) > self._max_bytes:
                raise TooLargeError("body", f"must be at most {self._max_bytes} bytes")
            return message

        await self._app(scope, counted, send)
