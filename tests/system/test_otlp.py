"""Spans reach an OTLP collector from all three services, under the trace id of the client."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.cluster import wait_for
from benchmarks.local_gateway import PATIENT_SERVICES
from pointslam.client import Client, FrameOptions
from pointslam.launcher import LaunchOptions, Services
from shared.camera import Calibration, Camera, Intrinsics

pytestmark = pytest.mark.system

TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"
WANTED = {
    ("pointslam-gateway", "frame", TRACE),
    ("pointslam-tracking", "track frame", TRACE),
    ("pointslam-mapping", "session advance", TRACE),
}
CALIBRATION = Calibration(Camera(Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)), 1000.0)


@pytest.fixture
def received(tmp_path):
    """What a collector was sent: its port on the first line, then a line for each span."""
    file = tmp_path / "received"
    with file.open("w") as out:
        collector = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("otlp_receiver.py"))], stdout=out
        )
    try:
        wait_for(lambda: file.read_text().endswith("\n"))
        yield file
    finally:
        collector.kill()
        collector.wait()


@pytest.fixture
def url(received, tmp_path):
    traces = f"http://127.0.0.1:{received.read_text().strip()}"
    options = LaunchOptions(
        tmp_path / "data",
        tmp_path / "logs",
        num_trackers=1,
        device="cpu",
        traces=traces,
        settings=PATIENT_SERVICES,
    )
    with Services(options) as started:
        yield started.url


def test_a_collector_is_sent_the_spans_of_a_clients_trace_by_all_three_services(received, url):
    rgb = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    depth = np.full((240, 320), 1500, np.uint16)
    options = FrameOptions(traceparent=f"00-{TRACE}-00f067aa0ba902b7-01")

    with Client(url) as client:
        session = client.create_session(CALIBRATION, mode="offline")
        session.track(rgb, depth, 0)
        list(session.stream([session.frame(rgb, depth, 10**9, options)]))

    wait_for(lambda: spans(received) >= WANTED)


def spans(received):
    """Service, name and trace of the spans whose lines are complete."""
    whole = received.read_text().rpartition("\n")[0]
    return {tuple(json.loads(line)) for line in whole.splitlines()[1:]}
