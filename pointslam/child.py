"""`python -m pointslam.child PARENT MODULE ...`: run a module that ends with its parent process.

The kernel is asked here, in the child: between fork and exec of a parent with threads, where gRPC
wakes its own for a moment, no Python may run.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Tie this process to its parent, then become the module."""
    parent, module = int(sys.argv[1]), sys.argv[2]
    # The kernel's own watch, so that not even kill -9 of the launcher leaves services behind.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit("the process that started this one has ended")
    sys.argv[1:] = sys.argv[3:]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
