"""Giving memory that nothing uses back to the system, before something large needs its place."""

from __future__ import annotations

import ctypes

from services.mapping.rasterizer.scratch import scratch


def give_back() -> None:
    """Let go of idle scratch arrays, and of the holes that glibc keeps between what is in use.

    On house-sparse that is a quarter of a gigabyte, as much as a copy of the map takes. Other C
    libraries have no `malloc_trim`.
    """
    scratch().release()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
