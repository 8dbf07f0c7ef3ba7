"""Child processes: ready, ended with a tail of the log, gone with their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pointslam.launcher import free_ports
from pointslam.process import Command, ServiceProcess
from shared.errors import UnavailableError

pytestmark = pytest.mark.system


def router(tmp_path: Path, endpoint: str | None = None) -> ServiceProcess:
    endpoint = endpoint or f"tcp/127.0.0.1:{free_ports(1)[0]}"
    return ServiceProcess(
        Command("router", "router", "pointslam.router", ("--listen", endpoint)), tmp_path
    )


def test_a_router_becomes_ready_and_ends_when_asked(tmp_path):
    process = router(tmp_path)
    process.wait_ready(time.monotonic() + 300)
    memory = process.peak_rss_bytes()

    process.terminate()
    process.wait(60.0)

    assert memory > 5e6
    assert not process.is_running()


def test_a_process_that_cannot_start_shows_the_end_of_its_log(tmp_path):
    process = router(tmp_path, "tcp/not-an-address:1")

    with pytest.raises(UnavailableError, match=r"router ended with code 2[\s\S]*cannot listen"):
        process.wait_ready(time.monotonic() + 300)


def test_a_process_that_ended_can_be_started_again(tmp_path):
    process = router(tmp_path)
    process.wait_ready(time.monotonic() + 300)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(60.0)

    process.restart()
    process.wait_ready(time.monotonic() + 300)

    assert process.is_running()
    process.terminate()
    process.wait(60.0)


def test_children_die_with_a_parent_that_is_killed(tmp_path):
    script = (
        "import sys, time; from pathlib import Path\n"
        "from pointslam.process import Command, ServiceProcess\n"
        "command = Command('router', 'router', 'pointslam.router', ('--listen', sys.argv[2]))\n"
        "process = ServiceProcess(command, Path(sys.argv[1]))\n"
        "process.wait_ready(time.monotonic() + 300)\n"
        "print(process.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    words = [sys.executable, "-c", script, str(tmp_path), endpoint]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()

    deadline = time.monotonic() + 60
    while _is_alive(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _is_alive(child)


def _is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"
