"""The asynchronous client, with the same calls as the synchronous one."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from typing import Any, TypeVar

import httpx
import numpy as np
from numpy.typing import NDArray

from pointslam.client import calls
from pointslam.client.async_session import AsyncSession
from pointslam.client.gateways import Gateways, may_ask_again
from shared.camera import Calibration
from shared.errors import UnavailableError

T = TypeVar("T")


class AsyncClient:
    """A gateway; an asynchronous context manager. For several, and for `api_key`, see `Client`.

    A frame stream does not go on by itself at another gateway: open it again.
    """

    def __init__(
        self, url: str | Sequence[str] = "http://127.0.0.1:8080", api_key: str | None = None
    ) -> None:
        self.gateways = Gateways(url)
        self.headers = calls.key_headers(api_key)
        self._http = httpx.AsyncClient(base_url=self.url, headers=self.headers)

    @property
    def url(self) -> str:
        """The gateway in use."""
        return self.gateways.url

    def turn(self) -> None:
        """Use the next gateway from here on."""
        self.gateways.turn()
        self._http.base_url = self.url

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._http.aclose()

    async def ready(self) -> bool:
        """Whether the gateway answers and sessions can be created and tracked."""
        try:
            return await self.call(calls.ready())
        except UnavailableError:
            return False

    async def sessions(self) -> list[dict[str, Any]]:
        """All sessions, those on disk too, newest first."""
        return await self.call(calls.list_sessions())

    async def create_session(
        self,
        calibration: Calibration,
        *,
        name: str | None = None,
        mode: str = "live",
        seed: int = 0,
        T_map_first: NDArray[np.float64] | None = None,
    ) -> AsyncSession:
        """A new session; see `Client.create_session`."""
        new = calls.NewSession(calibration, name, mode, seed, T_map_first)
        return AsyncSession(self, await self.call(calls.create_session(new)))

    async def session(self, name: str) -> AsyncSession:
        """A session that exists, taken up again from disk if need be."""
        return AsyncSession(self, await self.call(calls.info(name)))

    async def call(self, call: calls.Call[T]) -> T:
        """Send one call and read its answer.

        Raises:
            PointSlamError: the gateway refused, or does not answer.
        """
        for left in reversed(range(len(self.gateways))):
            try:
                return call.answer(
                    await self._http.request(call.method, call.path, **call.arguments())
                )
            except httpx.TransportError as error:
                unreachable = self._unreachable(error)
                self.turn()
                if not left or not may_ask_again(error, call.method):
                    raise unreachable from None
        raise AssertionError("there is at least one gateway")

    async def lines(self, path: str) -> AsyncIterator[str]:
        """The lines of an event stream as they come.

        Raises:
            PointSlamError: the gateway refused, or the stream broke.
        """
        try:
            async with self._http.stream("GET", path, timeout=calls.SLOW_S) as response:
                if not response.is_success:
                    await response.aread()
                    raise calls.error_from(calls.problem_of(response))
                async for line in response.aiter_lines():
                    yield line
        except httpx.TransportError as error:
            raise self._unreachable(error) from None

    async def download(self, path: str, params: dict[str, str]) -> AsyncIterator[bytes]:
        """A file piece by piece.

        Raises:
            PointSlamError: the gateway refused, or broke off.
        """
        try:
            async with self._http.stream(
                "GET", path, params=params, timeout=calls.SLOW_S
            ) as response:
                if not response.is_success:
                    await response.aread()
                    raise calls.error_from(calls.problem_of(response))
                async for piece in response.aiter_bytes():
                    yield piece
        except httpx.TransportError as error:
            raise self._unreachable(error) from None

    def _unreachable(self, error: Exception) -> UnavailableError:
        reason = f"{type(error).__name__}: {error}"
        return UnavailableError(f"{self.url} does not answer ({reason})")
