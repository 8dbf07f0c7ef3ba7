"""Session names belong to a tenant: on the bus and on disk they carry its name."""

from __future__ import annotations

import re

from services.gateway.access.caller import current_caller
from shared.api_keys import DEFAULT_TENANT
from shared.errors import NotFoundError

# Without the dot that parts tenant and name: no name can spell another tenant's session.
SESSION_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_PART = "."


def full_name(name: str) -> str:
    """The name on the bus and on disk of the caller's session.

    Raises:
        NotFoundError: no session can have such a name.
    """
    if not SESSION_NAME.fullmatch(name):
        raise NotFoundError(f"no session {name[:64]!r}")
    tenant = current_caller().tenant
    return name if tenant == DEFAULT_TENANT else f"{tenant}{_PART}{name}"


def public_name(full: str) -> str:
    """The name that the session's tenant knows it by."""
    return full.rpartition(_PART)[2]


def is_callers(full: str) -> bool:
    """Whether a session is of the caller's tenant."""
    tenant = full.rpartition(_PART)[0] or DEFAULT_TENANT
    return tenant == current_caller().tenant
