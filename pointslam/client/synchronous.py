"""The synchronous client."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import httpx
import numpy as np
from numpy.typing import NDArray

from pointslam.client import calls
from pointslam.client.gateways import Gateways, may_ask_again
from pointslam.client.session import Session
from shared.camera import Calibration
from shared.errors import UnavailableError

T = TypeVar("T")


class Client:
    """A gateway; a context manager. Not for use by several threads at once.

    Without `api_key` the one in POINTSLAM_API_KEY is sent, if there is one. A certificate of an
    authority of your own is trusted by its file in SSL_CERT_FILE. Of several gateways of one
    system (a sequence of addresses) another is asked when one does not answer.
    """

    def __init__(
        self, url: str | Sequence[str] = "http://127.0.0.1:8080", api_key: str | None = None
    ) -> None:
        self.gateways = Gateways(url)
        self.headers = calls.key_headers(api_key)
        self._http = httpx.Client(base_url=self.url, headers=self.headers)

    @property
    def url(self) -> str:
        """The gateway in use."""
        return self.gateways.url

    def turn(self) -> None:
        """Use the next gateway from here on."""
        self.gateways.turn()
        self._http.base_url = self.url

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections; sessions go on."""
        self._http.close()

    def ready(self) -> bool:
        """Whether the gateway answers and sessions can be created and tracked."""
        try:
            return self.call(calls.ready())
        except UnavailableError:
            return False

    def sessions(self) -> list[dict[str, Any]]:
        """All sessions, those on disk too, newest first."""
        return self.call(calls.list_sessions())

    def create_session(
        self,
        calibration: Calibration,
        *,
        name: str | None = None,
        mode: str = "live",
        seed: int = 0,
        T_map_first: NDArray[np.float64] | None = None,
    ) -> Session:
        """A new session, offline (no frame is lost, runs repeat) or live (newest frame wins).

        Raises:
            InputError: names the field of the calibration that no camera has.
            ConflictError: a session of that name exists.
            UnavailableError: no mapper is there.
        """
        new = calls.NewSession(calibration, name, mode, seed, T_map_first)
        return Session(self, self.call(calls.create_session(new)))

    def session(self, name: str) -> Session:
        """A session that exists, taken up again from disk if need be.

        Raises:
            NotFoundError: there is none of that name.
        """
        return Session(self, self.call(calls.info(name)))

    def call(self, call: calls.Call[T]) -> T:
        """Send one call and read its answer.

        Raises:
            PointSlamError: the gateway refused.
            UnavailableError: it does not answer.
        """
        for left in reversed(range(len(self.gateways))):
            try:
                return call.answer(self._http.request(call.method, call.path, **call.arguments()))
            except httpx.TransportError as error:
                unreachable = _unreachable(self.url, error)
                self.turn()
                if not left or not may_ask_again(error, call.method):
                    raise unreachable from None
        raise AssertionError("there is at least one gateway")

    def lines(self, path: str) -> Iterator[str]:
        """The lines of an event stream as they come.

        Raises:
            PointSlamError: the gateway refused.
            UnavailableError: the stream broke.
        """
        try:
            with self._http.stream("GET", path, timeout=calls.SLOW_S) as response:
                if not response.is_success:
                    response.read()
                    raise calls.error_from(calls.problem_of(response))
                yield from response.iter_lines()
        except httpx.TransportError as error:
            raise _unreachable(self.url, error) from None

    def download(self, path: str, params: dict[str, str], target: Path) -> None:
        """Fetch a file piece by piece."""
        arguments = {"params": params, "timeout": calls.SLOW_S}
        try:
            with self._http.stream("GET", path, **arguments) as response:
                if not response.is_success:
                    response.read()
                    raise calls.error_from(calls.problem_of(response))
                part = target.with_name(f"{target.name}.part")  # a torn file keeps this name
                with part.open("wb") as file:
                    for piece in response.iter_bytes():
                        file.write(piece)
                part.replace(target)
        except httpx.TransportError as error:
            raise _unreachable(self.url, error) from None


def _unreachable(url: str, error: Exception) -> UnavailableError:
    return UnavailableError(f"{url} does not answer ({type(error).__name__}: {error})")
