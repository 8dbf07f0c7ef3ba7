"""One child process: its log, whether it serves, its memory, its end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from shared.errors import UnavailableError

_TAIL_LINES = 15
DEFAULT_ENVIRONMENT = {  # what is set already stays
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",  # else what each of many threads once needed stays with its own arena
    "MALLOC_MMAP_THRESHOLD_": "4194304",  # else large arrays that are gone leave holes behind
}


@dataclass(frozen=True)
class Command:
    """A service's module and its arguments; `role` groups processes of one kind."""

    name: str
    role: str
    module: str
    arguments: tuple[str, ...]


class ServiceProcess:
    """A running service. Its output goes to a log file, where READY is looked for."""

    def __init__(self, command: Command, log_folder: Path) -> None:
        self.command = command
        self.log = log_folder / f"{command.name}.log"
        log_folder.mkdir(parents=True, exist_ok=True)
        self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        tied = ("-m", "pointslam.child", str(os.getpid()))  # not even kill -9 of ours leaves it
        with self.log.open("wb") as log:
            return subprocess.Popen(
                [sys.executable, *tied, self.command.module, *self.command.arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=DEFAULT_ENVIRONMENT | os.environ | {"PYTHONUNBUFFERED": "1"},
                process_group=0,  # Ctrl-C is ours to handle, in order; priorities hold in a session
            )

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def is_running(self) -> bool:
        """Whether it lives."""
        return self._process.poll() is None

    def is_ready(self) -> bool:
        """Whether it has said that it serves."""
        return any(line.startswith("READY ") for line in self._lines())

    def wait_ready(self, deadline: float) -> None:
        """Wait for READY.

        Raises:
            UnavailableError: it ended or did not become ready; holds the end of its log.
        """
        while not self.is_ready():
            self.check()
            if time.monotonic() > deadline:
                raise UnavailableError(f"{self.command.name} did not become ready\n{self.tail()}")
            time.sleep(0.05)

    def check(self) -> None:
        """Raise UnavailableError, with the end of its log, if it has ended."""
        code = self._process.poll()
        if code is not None:
            raise UnavailableError(f"{self.command.name} ended with code {code}\n{self.tail()}")

    def tail(self) -> str:
        """The last lines of its log, and where it is."""
        return "\n".join([*self._lines()[-_TAIL_LINES:], f"({self.log})"])

    def peak_rss_bytes(self) -> int:
        """The most memory it ever held; 0 when it is gone."""
        try:
            status = Path(f"/proc/{self.pid}/status").read_text()
        except OSError:
            return 0
        fields = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
        return int(fields.get("VmHWM", "0 kB").split()[0]) * 1024

    def restart(self) -> None:
        """Start it again; its log begins anew."""
        self._process = self._start()

    def terminate(self) -> None:
        """Ask it to end."""
        if self.is_running():
            self._process.send_signal(signal.SIGTERM)

    def wait(self, timeout_s: float) -> int:
        """Wait for its end, and enforce it when the time is over; its exit code."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def _lines(self) -> list[str]:
        return self.log.read_text(errors="replace").splitlines()
