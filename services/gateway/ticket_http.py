"""HTTP: tickets for browsers, which cannot send a key with a socket or an event stream."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from services.gateway import examples
from services.gateway.access.authority import Authority
from services.gateway.access.caller import current_caller


def ticket_routes(authority: Authority) -> APIRouter:
    """The route of tickets."""
    router = APIRouter()

    @router.post("/v1/tickets", status_code=201, responses=examples.TICKET)
    async def create_ticket() -> dict[str, Any]:
        """A ticket that does what the key does, once, as `?ticket=` of a WebSocket or event stream.

        The key itself never belongs into a URL, which logs and histories keep.
        """
        tickets = authority.tickets
        return {"ticket": tickets.issue(current_caller()), "expires_in_s": tickets.life_s}

    return router
