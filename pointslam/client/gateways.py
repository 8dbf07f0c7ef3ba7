"""The gateways of one system: any of them serves any session, one is asked at a time."""

from __future__ import annotations

from collections.abc import Sequence

import httpx

from shared.errors import ConfigError


class Gateways:
    """Addresses, and which of them is in use."""

    def __init__(self, urls: str | Sequence[str]) -> None:
        listed = [urls] if isinstance(urls, str) else list(urls)
        if not listed:
            raise ConfigError("a client needs the address of a gateway")
        self._urls = [_checked(url.rstrip("/")) for url in listed]

    def __len__(self) -> int:
        return len(self._urls)

    @property
    def url(self) -> str:
        """The address in use."""
        return self._urls[0]

    def turn(self) -> None:
        """Use the next address; the present one comes last."""
        self._urls.append(self._urls.pop(0))


def _checked(url: str) -> str:
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise ConfigError(f"the gateway's address {url!r} is no URL ({error})") from None
    if parsed.scheme not in ("http", "https") or not parsed.host:
        raise ConfigError(f"the gateway's address must be http(s)://host:port, got {url!r}")
    return url


def may_ask_again(error: httpx.TransportError, method: str) -> bool:
    """Whether another gateway may be asked the same: it reads only, or it never arrived."""
    return method == "GET" or isinstance(error, httpx.ConnectError | httpx.ConnectTimeout)
