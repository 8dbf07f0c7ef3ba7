"""What log lines say of a frame, and how a trace crosses the bus."""

import json
import logging
import subprocess
import sys
import time

from benchmarks.local_gateway import PATIENT_BUS, PATIENT_ROUTER, free_port
from shared import tracing
from shared.bus import Keys, open_bus, open_router
from shared.errors import GoneError
from shared.maps import Empty
from shared.service import JsonFormatter

TRACE = "0af7651916cd43dd8448eb211c80319c"
TRACEPARENT = f"00-{TRACE}-b7ad6b7169203331-01"


def line(text="something happened"):
    record = logging.LogRecord("test", logging.INFO, __file__, 1, text, None, None)
    return json.loads(JsonFormatter().format(record))


def test_a_log_line_says_which_frame_it_is_about():
    with tracing.log_fields(session="room", epoch=2), tracing.log_fields(seq=7):
        said = line()

    assert (said["session"], said["epoch"], said["seq"]) == ("room", 2, 7)
    assert "session" not in line()


def test_a_log_line_has_the_trace_that_the_client_gave():
    with tracing.span("frame", TRACEPARENT):
        assert line()["trace_id"] == TRACE
    assert "trace_id" not in line()


def test_a_traceparent_that_is_none_makes_no_trace():
    with tracing.span("frame", "00-zz-1"):
        assert tracing.outgoing() == ""


def test_a_trace_and_a_session_reach_whoever_answers():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router, heard = open_router(endpoint, PATIENT_ROUTER), []
    key = Keys.session("room", 3, "keyframes")
    with open_bus([endpoint], PATIENT_BUS) as bus, open_bus([endpoint], PATIENT_BUS) as other:
        other.serve(key, Empty, lambda request: heard.append(tracing.present_fields()) or request)
        deadline = time.monotonic() + 60.0
        while not heard:
            assert time.monotonic() < deadline
            try:
                with tracing.span("frame", TRACEPARENT):
                    bus.query(key, Empty(), Empty, 60.0)
            except GoneError:
                time.sleep(0.01)
    router.close()

    assert heard[0] == {"session": "room", "epoch": 3, "trace_id": TRACE}


def test_a_target_that_is_none_is_refused_in_one_line():
    command = [sys.executable, "-m", "services.gateway", "--traces", "somewhere"]
    ended = subprocess.run([*command, "--insecure-local"], capture_output=True, text=True)

    assert ended.returncode == 2
    assert "--traces must be http(s)://host:port or file:FOLDER" in ended.stderr
