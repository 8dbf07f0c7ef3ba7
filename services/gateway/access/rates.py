"""How much a key may ask for: token buckets."""

from __future__ import annotations

import time

from shared.errors import RateLimitedError


class TokenBucket:
    """Fills at a rate, up to what comes together in `burst_s` seconds, and never below one."""

    def __init__(self, rate_per_s: float, burst_s: float) -> None:
        self._rate_per_s = rate_per_s
        self._size = max(rate_per_s * burst_s, 1.0)
        self._level = self._size
        self._at = time.monotonic()

    def take(self) -> float:
        """Take one; returns 0, or where there is none the seconds until there will be."""
        now = time.monotonic()
        self._level = min(self._level + (now - self._at) * self._rate_per_s, self._size)
        self._at = now
        if self._level < 1.0:
            return (1.0 - self._level) / self._rate_per_s
        self._level -= 1.0
        return 0.0


class Budget:
    """The requests and frames of one key; unlimited where nothing is given."""

    def __init__(
        self, requests: TokenBucket | None = None, frames: TokenBucket | None = None
    ) -> None:
        self._requests = requests
        self._frames = frames

    def take_request(self) -> None:
        """Count a request.

        Raises:
            RateLimitedError: there were too many.
        """
        _take(self._requests, "requests")

    def take_frame(self) -> None:
        """Count a frame.

        Raises:
            RateLimitedError: there were too many.
        """
        _take(self._frames, "frames")


def _take(bucket: TokenBucket | None, what: str) -> None:
    wait_s = bucket.take() if bucket is not None else 0.0
    if wait_s > 0.0:
        raise RateLimitedError(f"too many {what} with this key; wait {wait_s:.2f} s", wait_s)
