"""Who waits for whom on a busy machine: a pose is due now, an iteration of the map is not.

Only the threads that optimise give way. Those that answer a tracker's questions do not: a frame
waits for them.
"""

from __future__ import annotations

import os
import threading

_LOWEST = 19


def give_way(niceness: int) -> None:
    """Lower the priority of this thread, and of all that it starts, by so many steps.

    A step is worth about 20 % of the processor where two threads want the same core (man 7 sched).
    """
    thread = threading.get_native_id()
    now = os.getpriority(os.PRIO_PROCESS, thread)
    os.setpriority(os.PRIO_PROCESS, thread, min(now + niceness, _LOWEST))
