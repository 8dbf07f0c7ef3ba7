"""Who a request is from."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass, field

from services.gateway.access.rates import Budget
from shared.api_keys import DEFAULT_TENANT, Scope


@dataclass(frozen=True)
class Caller:
    """A key (or a token) that was accepted, and what it may do."""

    id: str
    tenant: str = DEFAULT_TENANT
    scopes: frozenset[Scope] = frozenset(Scope)
    expires_s: float | None = None  # seconds since 1970
    budget: Budget = field(default_factory=Budget)


# Set by the doors' guards around each request. What looks sessions up reads it, so that a new route
# stays within its caller's tenant without a word of its own; without a caller it fails.
CALLER: ContextVar[Caller] = ContextVar("caller")


def current_caller() -> Caller:
    """Who this request, or the task that it started, is from."""
    return CALLER.get()
