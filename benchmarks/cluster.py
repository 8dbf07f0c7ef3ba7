"""Real services on one machine that are killed, frozen, woken and started again by name."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from pointslam.client import Client
from pointslam.launcher import START_TIMEOUT_S, LaunchOptions, Services
from pointslam.process import ServiceProcess
from shared.errors import UnavailableError


class Cluster:
    """A router, a gateway, trackers and mappers; signals go to single processes of them."""

    def __init__(self, services: Services) -> None:
        self.url = services.url
        self.grpc_address = f"127.0.0.1:{services.grpc_port}"
        self._processes = {process.command.name: process for process in services.processes}

    def names(self, role: str) -> list[str]:
        """The processes of a role: router, tracking, mapping or gateway."""
        return [name for name, each in self._processes.items() if each.command.role == role]

    def process(self, name: str) -> ServiceProcess:
        """One of the processes."""
        return self._processes[name]

    def kill(self, name: str) -> None:
        """End a process as the kernel would when memory is short."""
        victim = self._processes[name]
        os.kill(victim.pid, signal.SIGKILL)
        victim.wait(60.0)

    def end(self, name: str) -> int:
        """Ask a process to end, as a deploy does; its exit code."""
        self._processes[name].terminate()
        return self._processes[name].wait(60.0)

    def freeze(self, name: str) -> None:
        """Let a process live and do nothing."""
        os.kill(self._processes[name].pid, signal.SIGSTOP)

    def wake(self, name: str) -> None:
        """Let a frozen process go on."""
        os.kill(self._processes[name].pid, signal.SIGCONT)

    def start(self, name: str) -> None:
        """Start a process that was killed, and wait until it serves."""
        self._processes[name].restart()
        self._processes[name].wait_ready(time.monotonic() + START_TIMEOUT_S)

    def is_whole(self) -> bool:
        """Whether every process lives."""
        return all(process.is_running() for process in self._processes.values())

    def rss_mb(self, name: str) -> float:
        """Memory that a process holds now, MB."""
        return rss_mb(self._processes[name].pid)

    def wait_until_ready(self) -> None:
        """Wait until sessions can be created and tracked."""
        with Client(self.url) as client:
            wait_for(client.ready)


def rss_mb(pid: int) -> float:
    """Memory that a process of this machine holds now, MB."""
    pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6


def cpu_s(pid: int) -> float:
    """Processor time that a process of this machine has used, its threads together, seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def running_cluster(folder: Path, options: LaunchOptions | None = None) -> Iterator[Cluster]:
    """Start services whose maps and logs go into `folder`; they end with the context."""
    options = options or LaunchOptions(folder / "data", folder / "logs", device="cpu")
    options = replace(options, data=folder / "data", logs=folder / "logs")
    with Services(options) as services:
        cluster = Cluster(services)
        cluster.wait_until_ready()
        yield cluster


def wait_for(holds: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Wait until something holds.

    Raises:
        UnavailableError: it does not, in that time.
    """
    deadline = time.monotonic() + timeout_s
    while not holds():
        if time.monotonic() > deadline:
            raise UnavailableError(f"not so after {timeout_s:.0f} s")
        time.sleep(0.02)
