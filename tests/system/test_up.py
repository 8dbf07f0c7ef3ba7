"""`pointslam up` as a user runs it: ready, healed, ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from pointslam.client import Client
from pointslam.launcher import LaunchOptions, Services, free_ports

pytestmark = pytest.mark.system


def within(seconds: float, holds: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + seconds
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.1)
    return holds()


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_up_serves_until_it_is_asked_to_end(tmp_path):
    http, grpc = (str(port) for port in free_ports(2))
    words = ["up", "--data", str(tmp_path), "--http-port", http, "--grpc-port", grpc]
    command = [sys.executable, "-m", "pointslam.cli", *words, "--device", "cpu", "--trackers", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        with Client(f"http://127.0.0.1:{http}") as client:
            is_ready = within(300, client.ready)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)

    assert http in first and is_ready
    assert process.returncode == 0


def test_a_killed_tracker_is_started_again_and_stop_leaves_nobody(tmp_path):
    options = LaunchOptions(tmp_path / "data", tmp_path / "logs", num_trackers=1, device="cpu")
    with Services(options) as services, Client(services.url) as client:
        pids = [process.pid for process in services.processes]
        tracker = services.processes[1]
        os.kill(tracker.pid, signal.SIGKILL)
        within(60, lambda: not tracker.is_running())
        restarted = services.restart_ended()
        tracker.wait_ready(time.monotonic() + 300)
        is_ready = within(300, client.ready)
        pids.append(tracker.pid)

    assert restarted == ["tracker-0"] and is_ready
    assert not any(is_alive(pid) for pid in pids)
