"""The mapping process itself, over a real router."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from shared.bus import Bus, GoneError, Keys, open_bus, open_router
from shared.errors import ConflictError, InputError, NotFoundError
from shared.maps import (
    DeleteRequest,
    Empty,
    ExportChunk,
    ExportFormat,
    ExportRequest,
    MapInfo,
    RenderReply,
    RenderRequest,
    SessionList,
)
from shared.tracks import (
    AdvanceReply,
    ContextRequest,
    KeyframePoses,
    OpenReply,
    OpenRequest,
    TrackingContext,
)

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    router = open_router(f"tcp/127.0.0.1:{port}")
    yield f"tcp/127.0.0.1:{port}"
    router.close()


@pytest.fixture
def bus(endpoint) -> Iterator[Bus]:
    with open_bus([endpoint]) as bus:
        yield bus


@pytest.fixture
def start(endpoint, tmp_path) -> Iterator[Callable[[], subprocess.Popen]]:
    """Starts the mapper m0 on one data folder and waits until it is ready."""
    started = []

    def run() -> subprocess.Popen:
        command = [sys.executable, "-m", "services.mapping", "--connect", endpoint]
        command += ["--id", "m0", "--data", str(tmp_path / "data"), "--device", "cpu"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "READY m0\n"
        return process

    yield run
    for process in started:
        process.kill()
        process.wait()


def opened(bus: Bus, calibration=None, session="room") -> OpenReply:
    request = OpenRequest(session, "offline", 0, calibration)
    return bus.query(Keys.mapper("m0", "open"), request, OpenReply, 30.0)


def advance(bus: Bus, opening: OpenReply, entry) -> AdvanceReply:
    key = Keys.session(opening.session, opening.epoch, "advance")
    return bus.query(key, entry, AdvanceReply, 30.0)


def ask(bus: Bus, opening: OpenReply, question: str, message, kind):
    key = Keys.session(opening.session, opening.epoch, question)
    return bus.query(key, message, kind, 30.0)


def test_every_acknowledged_keyframe_survives_kill_9(start, bus, calibration, entry):
    process = start()
    before = opened(bus, calibration)
    for seq in range(10):
        advance(bus, before, entry(seq))
    process.send_signal(signal.SIGKILL)
    process.wait()

    start()
    after = opened(bus)

    assert after.epoch == before.epoch + 1
    assert after.keyframe_poses.seqs.tolist() == [0, 4, 8]
    assert (after.last.seq, after.map_revision) == (9, 3)
    assert advance(bus, after, entry(10)).map_revision == 3


def test_sigterm_ends_the_process_cleanly_with_a_snapshot(start, bus, calibration, entry, tmp_path):
    process = start()
    opening = opened(bus, calibration)
    advance(bus, opening, entry(0))

    process.send_signal(signal.SIGTERM)

    assert process.wait(timeout=20) == 0
    assert (tmp_path / "data" / "room" / "snapshot-000001" / "manifest.json").exists()


def test_a_session_answers_every_question(start, bus, calibration, entry, true_pose):
    start()
    opening = opened(bus, calibration)
    for seq in range(5):
        advance(bus, opening, entry(seq))

    context = ask(bus, opening, "context", ContextRequest(2, 4), TrackingContext)
    poses = ask(bus, opening, "keyframes", Empty(), KeyframePoses)
    request = RenderRequest(true_pose(0), calibration.colour.intrinsics)
    view = ask(bus, opening, "render", request, RenderReply)
    info = ask(bus, opening, "info", Empty(), MapInfo)
    export = ExportRequest(ExportFormat.PLY)
    chunk = ask(bus, opening, "export", export, ExportChunk)

    assert (context.num_keyframes, poses.seqs.tolist()) == (2, [0, 4])
    assert (view.alpha > 200).mean() > 0.9
    assert (info.frames, info.keyframes, info.mapper) == (5, 2, "m0")
    assert chunk.bytes.startswith(b"ply\n")


def test_refused_requests_name_what_is_wrong(start, bus, calibration, entry):
    start()

    with pytest.raises(InputError, match="session"):
        opened(bus, calibration, "../room")
    with pytest.raises(NotFoundError, match="nowhere"):
        opened(bus, None, "nowhere")
    with pytest.raises(ConflictError, match="not newer"):
        opening = opened(bus, calibration)
        advance(bus, opening, entry(4))
        advance(bus, opening, entry(3))


def test_a_deleted_session_is_gone_from_bus_and_disk(start, bus, calibration, entry, tmp_path):
    start()
    opening = opened(bus, calibration)
    advance(bus, opening, entry(0))

    bus.query(Keys.mapper("m0", "delete"), DeleteRequest("room"), Empty, 30.0)

    assert not os.path.exists(tmp_path / "data" / "room")
    assert bus.query(Keys.mapper("m0", "list"), Empty(), SessionList, 30.0).sessions == ()
    with pytest.raises(GoneError):
        ask(bus, opening, "info", Empty(), MapInfo)


def test_the_list_names_open_and_closed_sessions(start, bus, calibration, entry):
    first = start()
    advance(bus, opened(bus, calibration, "old"), entry(0))
    first.kill()
    first.wait()
    start()
    opened(bus, calibration, "new")

    sessions = bus.query(Keys.mapper("m0", "list"), Empty(), SessionList, 30.0).sessions

    found = [(s.session, s.keyframes, s.is_open) for s in sessions]
    assert found == [("new", 0, True), ("old", 1, False)]
    assert np.all([s.created_ns > 0 for s in sessions])
