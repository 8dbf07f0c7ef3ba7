"""Tickets: what a browser shows where it cannot send a header, good for one use."""

from __future__ import annotations

import secrets
import time

from services.gateway.access.caller import Caller
from shared.errors import UnauthenticatedError

_MAX_TICKETS = 4096


class Tickets:
    """Tickets of this gateway that nobody has used yet."""

    def __init__(self, life_s: float) -> None:
        self.life_s = life_s
        self._open: dict[str, tuple[Caller, float]] = {}  # in the order of their end

    def issue(self, caller: Caller) -> str:
        """A ticket with which its holder is this caller, once."""
        now = time.monotonic()
        while self._open and (self._oldest_end() <= now or len(self._open) >= _MAX_TICKETS):
            del self._open[next(iter(self._open))]
        ticket = secrets.token_urlsafe(32)
        self._open[ticket] = (caller, now + self.life_s)
        return ticket

    def use(self, ticket: str) -> Caller:
        """Whom the ticket was given to; it is used up.

        Raises:
            UnauthenticatedError: it was never given, is used, or too old.
        """
        caller, end = self._open.pop(ticket, (None, 0.0))
        if caller is None or time.monotonic() >= end:
            raise UnauthenticatedError("the ticket is unknown, used or too old; ask for another")
        return caller

    def _oldest_end(self) -> float:
        return next(iter(self._open.values()))[1]
