"""A gRPC call that one task serves and another may abort at any moment."""

from __future__ import annotations

import asyncio
from typing import Any

import grpc


class SharedContext:
    """The context of a call whose first metadata is never on its way while it is aborted.

    grpc counts metadata as sent when the sending has ended. An abort in between sends them once
    more, which fails, and the call goes on as if nothing had been said.
    """

    def __init__(self, context: Any) -> None:
        self._context = context
        self._sending = asyncio.Lock()
        self._is_open = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    async def send_initial_metadata(self, metadata: tuple[tuple[str, str], ...]) -> None:
        """Say that the call is served; what follows is heard from here on."""
        async with self._sending:
            await self._context.send_initial_metadata(metadata)
            self._is_open = True

    async def open(self) -> None:
        """The same, where nothing was said yet: messages would bring metadata with them."""
        if not self._is_open:
            await self.send_initial_metadata(())

    async def write(self, message: Any) -> None:
        """A message of a response stream."""
        await self.open()
        await self._context.write(message)

    async def abort(
        self, code: grpc.StatusCode, details: str = "", trailing: tuple[tuple[str, str], ...] = ()
    ) -> None:
        """End the call with a status and trailing metadata; raises grpc.aio.AbortError."""
        async with self._sending:
            await self._context.abort(code, details, trailing)
