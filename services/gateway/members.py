"""Which processes of a role are alive, as their liveliness tokens say."""

from __future__ import annotations

import asyncio

from shared.bus import Bus


class Members:
    """Names of the live processes of one role; owned by the event loop."""

    def __init__(self, bus: Bus, role: str) -> None:
        self.names: frozenset[str] = frozenset()
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        bus.watch_alive(role, self._heard)

    async def wait_for_change(self, timeout_s: float) -> None:
        """Wait until a process comes or goes, or the time is over."""
        changed = self._changed
        try:
            await asyncio.wait_for(changed.wait(), timeout_s)
        except TimeoutError:
            return

    def _heard(self, name: str, is_alive: bool) -> None:
        # On zenoh's thread, and possibly after the loop has ended.
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._change, name, is_alive)

    def _change(self, name: str, is_alive: bool) -> None:
        self.names = self.names | {name} if is_alive else self.names - {name}
        self._changed.set()
        self._changed = asyncio.Event()
