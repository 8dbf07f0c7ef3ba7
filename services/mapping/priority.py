"""Who waits for whom on a busy machine: a pose is due now, an iteration of the map is not.

Only the threads that optimise give way. Those that answer a tracker's questions do not: a frame
waits for them.
"""

from __future__ import annotations

import contextlib
import os
import threading

_LOWEST = 19


def give_way(niceness: int, thread: int | None = None) -> None:
    """Lower the priority of a thread (of this one: None), and of all that it starts, by some steps.

    A step is worth about 20 % of the processor where two threads want the same core (man 7 sched).
    """
    thread = thread or threading.get_native_id()
    now = os.getpriority(os.PRIO_PROCESS, thread)
    os.setpriority(os.PRIO_PROCESS, thread, min(now + niceness, _LOWEST))


def others_give_way(niceness: int) -> None:
    """Lower all threads of this process but the present one; after the warm-up those are the pools.

    The warm-up itself does not give way: whoever starts a service waits for it.
    """
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and thread.native_id is not None:
            # One that ended meanwhile; those that a library started are listed for ever.
            with contextlib.suppress(ProcessLookupError):
                give_way(niceness, thread.native_id)
