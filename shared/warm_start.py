"""Kernels are compiled before a service begins, by a process that then begins anew.

The compiler never leaves the process in which it ran: a tracking worker that compiled its kernels
holds 250 MiB more, to its end, than one that loads them from Numba's cache, a mapper 290 MiB.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable

from numba.core.event import install_recorder

_BEGUN_ANEW = "POINTSLAM_BEGUN_ANEW"  # the variable that tells a process that it is the second one
_log = logging.getLogger(__name__)


def warm_start(warm_up: Callable[[], None], stop: threading.Event) -> None:
    """Call `warm_up`; if a kernel had to be compiled, run this program again in its place.

    Process id, arguments and environment stay; whatever was opened is closed, so this comes before
    anything that others may hold on to. It happens once: where Numba can't keep what it compiles,
    the second process says so and goes on.

    Args:
        warm_up: calls every kernel.
        stop: set by the signals of `stop_event`; a process that is told to end is not begun anew.
    """
    is_second = os.environ.pop(_BEGUN_ANEW, None) is not None
    with install_recorder("numba:compile") as compiled:
        warm_up()
    if not compiled.buffer:
        return
    if is_second:
        _log.warning(
            "Numba compiles at every start and takes some 300 MB for it, since it could not keep "
            "what it compiled: set NUMBA_CACHE_DIR to a folder that can be written"
        )
        return
    _begin_anew(stop)


def _begin_anew(stop: threading.Event) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)  # one that comes from here on must not be missed
    if stop.is_set():
        return
    _log.info("kernels are compiled; beginning anew without the compiler")
    os.environ[_BEGUN_ANEW] = "1"
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
