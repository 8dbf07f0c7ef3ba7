"""Which pages may talk to a gateway from a browser."""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlsplit

from shared.errors import ForbiddenError

_LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")


def check_origin(origin: str, host: str, allowed: Sequence[str]) -> None:
    """Refuse the requests of other sites' pages; programs send no origin.

    Raises:
        ForbiddenError: the page is neither this gateway's own nor of an allowed origin.
    """
    if origin and _site(origin) != host and origin not in allowed:
        raise ForbiddenError(
            f"pages of {origin[:100]} may not use this gateway (access.allowed_origins)"
        )


def check_local_host(host: str) -> None:
    """Refuse names that a foreign site could have pointed at this machine (DNS rebinding).

    Raises:
        ForbiddenError: the name is none of this machine's own.
    """
    if host and _name(host) not in _LOCAL_NAMES:
        raise ForbiddenError(f"--insecure-local answers to localhost only, not to {host[:100]}")


def _site(origin: str) -> str | None:
    """Host and port of an origin; None where it is no address."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None


def _name(host: str) -> str | None:
    """A Host header without its port; None where it is no address."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None
