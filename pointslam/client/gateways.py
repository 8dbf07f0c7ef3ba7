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
        self._urls = [url.rstrip("/") for url in listed]

    def __len__(self) -> int:
        return len(self._urls)

    @property
    def url(self) -> str:
        """The address in use."""
        return self._urls[0]

    def turn(self) -> None:
        """Use the next address; the present one comes last."""
        self._urls.append(self._urls.pop(0))


def may_ask_again(error: httpx.TransportError, method: str) -> bool:
    """Whether another gateway may be asked the same: it reads only, or it never arrived."""
    return method == "GET" or isinstance(error, httpx.ConnectError | httpx.ConnectTimeout)
