"""Before every HTTP and WebSocket route: who it is, and whether they may."""

from __future__ import annotations

import asyncio
from urllib.parse import parse_qs

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from services.gateway.access import audit
from services.gateway.access.authority import Authority, Shown
from services.gateway.access.caller import CALLER, Caller
from services.gateway.access.origins import check_local_host, check_origin
from services.gateway.access.routes import ADMIN, OPEN, Access, access_to
from services.gateway.problems import problem_response
from shared.errors import PointSlamError

_POLICY_VIOLATION = 1008


class HttpGuard:
    """ASGI middleware that lets no request through that the authority does not admit."""

    def __init__(self, app: ASGIApp, authority: Authority) -> None:
        self._app = app
        self._authority = authority

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse the request, or pass it on with its caller set."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        access = access_to(scope.get("method", "WS"), scope["path"])
        headers = _headers(scope)
        try:
            caller = self._admit(scope, headers, access)
        except PointSlamError as error:
            audit.refused(error, _action(scope), _client(scope), headers.get("authorization", ""))
            await _refuse(error, scope, receive, send)
            return
        if caller is None:
            await self._app(scope, receive, send)
            return
        mark = CALLER.set(caller)
        try:
            await self._pass(caller, access, scope, receive, send)
        finally:
            CALLER.reset(mark)

    def _admit(self, scope: Scope, headers: dict[str, str], access: Access) -> Caller | None:
        """The caller; None where everybody may come."""
        host = headers.get("host", "")
        if self._authority.is_local:
            check_local_host(host)
        check_origin(headers.get("origin", ""), host, self._authority.config.allowed_origins)
        if access == OPEN:
            return None
        ticket = parse_qs(scope["query_string"].decode("latin-1")).get("ticket", [""])[0]
        return self._authority.admit(Shown(headers.get("authorization", ""), ticket), access)

    async def _pass(
        self, caller: Caller, access: Access, scope: Scope, receive: Receive, send: Send
    ) -> None:
        status = "no answer"

        async def noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = str(message["status"])
            await send(message)

        try:
            if access.takes_ticket:
                await self._while_valid(caller, scope, receive, noted)
            else:
                await self._app(scope, receive, noted)
        finally:
            if access == ADMIN:
                audit.acted(caller, _action(scope), _client(scope), status)

    async def _while_valid(
        self, caller: Caller, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """Serve a stream until it ends, or its caller's key does."""
        serving = asyncio.ensure_future(self._app(scope, receive, send))
        try:
            while not (await asyncio.wait({serving}, timeout=self._authority.config.recheck_s))[0]:
                if self._authority.has_ended(caller):
                    await _cut(scope, send)
                    return
            serving.result()
        finally:
            serving.cancel()


async def _refuse(error: PointSlamError, scope: Scope, receive: Receive, send: Send) -> None:
    response = problem_response(error)
    if scope["type"] == "websocket":
        await WebSocket(scope, receive, send).send_denial_response(response)
    else:
        await response(scope, receive, send)


async def _cut(scope: Scope, send: Send) -> None:
    if scope["type"] == "websocket":
        reason = "the key is no longer accepted"
        await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": reason})


def _headers(scope: Scope) -> dict[str, str]:
    return {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}


def _action(scope: Scope) -> str:
    return f"{scope.get('method', 'WS')} {scope['path']}"


def _client(scope: Scope) -> str:
    return (scope.get("client") or ("unknown", 0))[0]
