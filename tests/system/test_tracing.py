"""One frame, one trace: spans in three processes, each below the one that asked."""

import json
import time

import numpy as np
import pytest

from pointslam.client import Client, FrameOptions
from shared.camera import Calibration, Camera, Intrinsics

pytestmark = pytest.mark.system

TRACE, CLIENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
CALIBRATION = Calibration(Camera(Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)), 1000.0)


def spans(services):
    """Spans of the trace by service and name, as far as they are written."""
    folder = services.processes[0].log.parent.parent / "traces"
    lines = [line for file in folder.glob("*.jsonl") for line in file.read_text().splitlines()]
    found = [json.loads(line) for line in lines]
    return {
        (span["resource"]["attributes"]["service.name"].removeprefix("pointslam-"), span["name"]): (
            span["context"]["span_id"],
            span["parent_id"],
        )
        for span in found
        if span["context"]["trace_id"] == f"0x{TRACE}"
    }


def test_a_frame_is_one_trace_from_the_client_to_the_map(services):
    rgb = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    depth = np.full((240, 320), 1500, np.uint16)
    wanted = {
        ("gateway", "frame"),
        ("tracking", "track frame"),
        ("mapping", "session context"),
        ("mapping", "session advance"),
    }
    with Client(services.url) as client:
        session = client.create_session(CALIBRATION, mode="offline")
        session.track(rgb, depth, 0)
        options = FrameOptions(traceparent=f"00-{TRACE}-{CLIENT}-01")
        for reply in session.stream([session.frame(rgb, depth, 10**9, options)]):
            assert reply.error is None
        session.delete()

    deadline = time.monotonic() + 60.0
    while not wanted <= (found := spans(services)).keys():
        assert time.monotonic() < deadline, found
        time.sleep(0.05)
    frame, track = found["gateway", "frame"], found["tracking", "track frame"]
    assert frame[1] == f"0x{CLIENT}"
    assert track[1] == frame[0]
    assert found["mapping", "session context"][1] == track[0]
    assert found["mapping", "session advance"][1] == frame[0]
