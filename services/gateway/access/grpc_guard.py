"""Before every gRPC method: who it is, and whether they may."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from services.gateway.access import audit
from services.gateway.access.authority import Authority, Shown
from services.gateway.access.caller import CALLER, Caller
from services.gateway.access.grpc_context import SharedContext
from services.gateway.access.routes import ADMIN, ANY, GRPC, OPEN, Access
from services.gateway.errors import MESSAGE
from services.gateway.grpc_errors import refusing
from shared.errors import InputError, PointSlamError

_Continue = Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler | None]]


class GrpcGuard(grpc.aio.ServerInterceptor):
    """Lets no call through that the authority does not admit."""

    def __init__(self, authority: Authority) -> None:
        self._authority = authority

    async def intercept_service(
        self, continuation: _Continue, handler_call_details: grpc.HandlerCallDetails
    ) -> Any:
        """The method's handler, with the question who calls before it."""
        handler = await continuation(handler_call_details)
        access = GRPC.get(handler_call_details.method, ANY)
        if handler is None or access == OPEN:
            return handler
        metadata = dict(handler_call_details.invocation_metadata or ())
        shown = Shown(str(metadata.get("authorization", "")))
        return _Guarded(self._authority, access, handler_call_details.method, shown).around(handler)


class _Guarded:
    """One call of one method."""

    def __init__(self, authority: Authority, access: Access, method: str, shown: Shown) -> None:
        self._authority = authority
        self._access = access
        self._method = method
        self._shown = shown

    def around(self, handler: Any) -> grpc.RpcMethodHandler:
        """A handler of the same kind."""
        if handler.request_streaming:
            make, behaviour = grpc.stream_stream_rpc_method_handler, handler.stream_stream
        elif handler.response_streaming:
            make, behaviour = grpc.unary_stream_rpc_method_handler, handler.unary_stream
        else:
            make, behaviour = grpc.unary_unary_rpc_method_handler, handler.unary_unary
        parsed = _parsing(behaviour, handler)
        guarded = self._stream(parsed) if _is_generator(behaviour) else self._call(parsed)
        # Without a deserializer grpc hands us the bytes: its own would blame the server for bad
        # ones (INTERNAL), and would read those of strangers before they are asked who they are.
        return make(guarded, None, handler.response_serializer)

    def _call(self, behaviour: Any) -> Callable[[Any, Any], Awaitable[Any]]:
        async def call(request: Any, served: Any) -> Any:
            context = SharedContext(served)
            caller = await self._admit(context)
            outcome = "OK"
            try:
                async with refusing(context), self._while_valid(caller, context):
                    return await behaviour(request, context)
            except BaseException:
                outcome = getattr(context.code(), "name", "INTERNAL")
                raise
            finally:
                if self._access == ADMIN:
                    audit.acted(caller, self._method, context.peer(), outcome)

        return call

    def _stream(self, behaviour: Any) -> Callable[[Any, Any], AsyncIterator[Any]]:
        async def stream(request: Any, served: Any) -> AsyncIterator[Any]:
            context = SharedContext(served)
            caller = await self._admit(context)
            async with refusing(context), self._while_valid(caller, context):
                async for response in behaviour(request, context):
                    await context.open()
                    yield response

        return stream

    async def _admit(self, context: Any) -> Caller:
        """Set the caller for what the method does; the call's task ends with it."""
        async with refusing(context):
            try:
                caller = self._authority.admit(self._shown, self._access)
            except PointSlamError as error:
                audit.refused(error, self._method, context.peer(), self._shown.authorization)
                raise
        CALLER.set(caller)
        return caller

    @asynccontextmanager
    async def _while_valid(self, caller: Caller, context: Any) -> AsyncIterator[None]:
        """End the call when its caller's key ends before it."""
        serving = asyncio.current_task()

        async def watch() -> None:
            while not self._authority.has_ended(caller):
                await asyncio.sleep(self._authority.config.recheck_s)
            with suppress(grpc.aio.AbortError):
                await context.abort(
                    grpc.StatusCode.UNAUTHENTICATED, "the key is no longer accepted"
                )
            if serving is not None:
                serving.cancel()

        watching = asyncio.create_task(watch())
        try:
            yield
        finally:
            watching.cancel()


def _parsing(behaviour: Any, handler: Any) -> Callable[[Any, Any], Any]:
    """The behaviour for requests as bytes."""

    async def parsed_all(requests: AsyncIterator[bytes]) -> AsyncIterator[Any]:
        async for data in requests:
            yield parse(data)

    def parse(data: bytes) -> Any:
        try:
            return handler.request_deserializer(data)
        except DecodeError as error:
            raise InputError(MESSAGE, f"is no protobuf message of this call ({error})") from None

    if handler.request_streaming:
        return lambda requests, context: behaviour(parsed_all(requests), context)
    return lambda data, context: behaviour(parse(data), context)


def _is_generator(behaviour: Any) -> bool:
    return inspect.isasyncgenfunction(behaviour)
