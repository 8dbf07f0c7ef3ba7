"""The process's heap: what is free in it goes back to the system."""

from __future__ import annotations

import ctypes


def trim() -> None:
    """Let go of the holes that glibc keeps between what is in use; takes milliseconds.

    Frames of some 100 kB come and go between small objects that stay, and where a frame does not
    fit into a hole new pages are taken: a service grows with every wave of clients, though it
    holds no more. Other C libraries have no `malloc_trim`.
    """
    release = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if release is not None:
        release(0)
