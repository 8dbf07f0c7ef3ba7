"""The mapping process itself, over a real router."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.local_gateway import PATIENT_BUS, PATIENT_ROUTER, free_port
from shared.bus import Bus, GoneError, Keys, open_bus, open_router
from shared.errors import ConflictError, InputError, NotFoundError
from shared.maps import (
    DeleteRequest,
    Empty,
    ExportChunk,
    ExportFormat,
    ExportRequest,
    KeyframeReply,
    KeyframeRequest,
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
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = open_router(endpoint, PATIENT_ROUTER)
    yield endpoint
    router.close()


@pytest.fixture(scope="module")
def start_at(endpoint) -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts a mapper of a name on a data folder and waits until it is ready."""
    started = []

    def run(name: str, data: Path, *settings: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "services.mapping", "--connect", endpoint]
        command += ["--id", name, "--data", str(data), "--device", "cpu"]
        command += [
            word for setting in ("bus.lease_s=60.0", *settings) for word in ("--set", setting)
        ]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == f"READY {name}\n"
        return process

    yield run
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def shared_mapper(start_at, tmp_path_factory) -> str:
    """A mapper for the tests that do not end it."""
    start_at("shared", tmp_path_factory.mktemp("shared"))
    return "shared"


@pytest.fixture
def bus(endpoint) -> Iterator[Bus]:
    with open_bus([endpoint], PATIENT_BUS) as bus:
        yield bus


@pytest.fixture
def start(start_at, tmp_path) -> Iterator[Callable[[], subprocess.Popen]]:
    """Starts the mapper m0 on this test's data folder; it ends with the test."""
    started = []

    def run() -> subprocess.Popen:
        started.append(start_at("m0", tmp_path / "data"))
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.wait()


def wait_for_mapper(bus: Bus, mapper: str) -> None:
    """As the gateway does: a mapper is there when its token is seen."""
    is_seen = threading.Event()

    def changed(name: str, is_alive: bool) -> None:
        if name == mapper and is_alive:
            is_seen.set()

    bus.watch_alive("mapping", changed)
    assert is_seen.wait(60.0)


def opened(bus: Bus, calibration=None, session="room", mapper="m0") -> OpenReply:
    wait_for_mapper(bus, mapper)
    request = OpenRequest(session, "offline", 0, calibration)
    return bus.query(Keys.mapper(mapper, "open"), request, OpenReply, 60.0)


def advance(bus: Bus, opening: OpenReply, entry) -> AdvanceReply:
    key = Keys.session(opening.session, opening.epoch, "advance")
    return bus.query(key, entry, AdvanceReply, 60.0)


def ask(bus: Bus, opening: OpenReply, question: str, message, kind):
    key = Keys.session(opening.session, opening.epoch, question)
    return bus.query(key, message, kind, 60.0)


def count_in(ply: bytes) -> int:
    return int(ply.split(b"element vertex ", 1)[1].split(b"\n", 1)[0])


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
    assert after.last is not None
    assert after.keyframe_poses.seqs.tolist() == [0, 4, 8]
    assert (after.last.seq, after.map_revision) == (9, 3)
    assert advance(bus, after, entry(10)).map_revision == 3


def test_sigterm_ends_the_process_cleanly_with_a_snapshot(start, bus, calibration, entry, tmp_path):
    process = start()
    opening = opened(bus, calibration)
    advance(bus, opening, entry(0))

    process.send_signal(signal.SIGTERM)

    assert process.wait(timeout=60) == 0
    assert (tmp_path / "data" / "room" / "snapshot-000001" / "manifest.json").exists()


def test_a_session_answers_every_question(shared_mapper, bus, calibration, entry, true_pose):
    opening = opened(bus, calibration, "room", shared_mapper)
    for seq in range(5):
        advance(bus, opening, entry(seq))

    context = ask(bus, opening, "context", ContextRequest(2, 4), TrackingContext)
    poses = ask(bus, opening, "keyframes", Empty(), KeyframePoses)
    request = RenderRequest(true_pose(0), calibration.colour.intrinsics)
    view = ask(bus, opening, "render", request, RenderReply)
    info = ask(bus, opening, "info", Empty(), MapInfo)
    chunk = ask(bus, opening, "export", ExportRequest(ExportFormat.PLY), ExportChunk)
    preview = ask(bus, opening, "export", ExportRequest(ExportFormat.PREVIEW), ExportChunk)
    keyframe = ask(bus, opening, "keyframe", KeyframeRequest(4), KeyframeReply)

    assert (context.num_keyframes, poses.seqs.tolist()) == (2, [0, 4])
    assert (view.alpha > 200).mean() > 0.8
    assert (info.frames, info.keyframes, info.mapper) == (5, 2, "shared")
    assert chunk.bytes.startswith(b"ply\n")
    assert count_in(preview.bytes) > 100
    assert keyframe.rgb.bytes.startswith(b"\xff\xd8")
    np.testing.assert_allclose(keyframe.T_world_camera, poses.T_world_keyframes[1])


def test_refused_requests_name_what_is_wrong(shared_mapper, bus, calibration, entry):
    opening = opened(bus, calibration, "ordered", shared_mapper)
    advance(bus, opening, entry(4))

    with pytest.raises(InputError, match="session"):
        opened(bus, calibration, "../room", shared_mapper)
    with pytest.raises(NotFoundError, match="nowhere"):
        opened(bus, None, "nowhere", shared_mapper)
    with pytest.raises(ConflictError, match="not newer"):
        advance(bus, opening, entry(3))
    with pytest.raises(NotFoundError, match="keyframe 5"):
        ask(bus, opening, "keyframe", KeyframeRequest(5), KeyframeReply)


def test_a_deleted_session_is_gone(shared_mapper, bus, calibration, entry):
    opening = opened(bus, calibration, "gone", shared_mapper)
    advance(bus, opening, entry(0))

    bus.query(Keys.mapper(shared_mapper, "delete"), DeleteRequest("gone"), Empty, 60.0)

    listed = bus.query(Keys.mapper(shared_mapper, "list"), Empty(), SessionList, 60.0)
    assert "gone" not in [summary.session for summary in listed.sessions]
    with pytest.raises(GoneError):
        ask(bus, opening, "info", Empty(), MapInfo)


def test_the_list_names_open_and_closed_sessions(start, bus, calibration, entry):
    first = start()
    advance(bus, opened(bus, calibration, "old"), entry(0))
    first.kill()
    first.wait()
    start()
    opened(bus, calibration, "new")

    sessions = bus.query(Keys.mapper("m0", "list"), Empty(), SessionList, 60.0).sessions

    found = [(s.session, s.keyframes, s.is_open) for s in sessions]
    assert found == [("new", 0, True), ("old", 1, False)]


def test_a_damaged_session_does_not_hide_the_others(start, bus, calibration, tmp_path):
    damaged = tmp_path / "data" / "damaged"
    damaged.mkdir(parents=True)
    (damaged / "session.msgpack").write_bytes(b"no record")
    start()
    opened(bus, calibration, "good")

    sessions = bus.query(Keys.mapper("m0", "list"), Empty(), SessionList, 60.0).sessions

    assert [s.session for s in sessions] == ["good"]


def test_a_new_session_holds_nothing_of_a_removal_that_broke_off(
    start, bus, calibration, entry, tmp_path
):
    first = start()
    advance(bus, opened(bus, calibration), entry(0))
    first.kill()
    first.wait()
    (tmp_path / "data" / "room" / "session.msgpack").unlink()
    start()

    opening = opened(bus, calibration)

    assert opening.last is None and len(opening.keyframe_poses.seqs) == 0


def test_a_session_that_nobody_asks_for_goes_to_disk_and_comes_back(
    start_at, bus, tmp_path, calibration, entry
):
    start_at("tidy", tmp_path, "owner.session_idle_s=2.0")
    # A name of its own: the other mappers on this router have a "room", with the same keys.
    opening = opened(bus, calibration, "tidied", "tidy")
    advance(bus, opening, entry(0))

    wait_until_gone(bus, opening)
    again = opened(bus, session="tidied", mapper="tidy")

    assert again.epoch == opening.epoch + 1
    assert again.keyframe_poses.seqs.tolist() == [0]


def wait_until_gone(bus: Bus, opening: OpenReply) -> None:
    key = Keys.mapper(opening.mapper, "list")
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        (summary,) = bus.query(key, Empty(), SessionList, 60.0).sessions
        if not summary.is_open:
            return
        time.sleep(0.1)
    raise AssertionError("still open after a minute without a question")


@pytest.fixture
def frozen_and_taken_over(start_at, bus, tmp_path, calibration, entry):
    """A session whose owner was frozen past its lease and succeeded; the owner is awake again."""
    first, second = f"first-{tmp_path.name}", f"second-{tmp_path.name}"
    frozen = start_at(first, tmp_path, "owner.lease_s=3.0")
    start_at(second, tmp_path, "owner.lease_s=3.0")
    before = opened(bus, calibration, tmp_path.name, first)
    for seq in range(5):
        advance(bus, before, entry(seq))
    with pytest.raises(ConflictError, match=f"owned by {first}@"):
        opened(bus, session=tmp_path.name, mapper=second)
    frozen.send_signal(signal.SIGSTOP)
    after = opened_in_time(bus, tmp_path.name, second)
    frozen.send_signal(signal.SIGCONT)
    return before, after


def test_a_frozen_owner_is_succeeded_when_its_lease_ends(frozen_and_taken_over, bus, entry):
    before, after = frozen_and_taken_over

    assert after.epoch > before.epoch
    assert after.keyframe_poses.seqs.tolist() == [0, 4]
    assert advance(bus, after, entry(5)).acknowledged_seq == 5


def test_a_woken_owner_acknowledges_nothing_and_steps_down(frozen_and_taken_over, bus, entry):
    before, after = frozen_and_taken_over

    with pytest.raises(GoneError):
        advance(bus, before, entry(5))

    wait_until_gone(bus, before)
    assert advance(bus, after, entry(5)).acknowledged_seq == 5


def opened_in_time(bus: Bus, session: str, mapper: str) -> OpenReply:
    deadline = time.monotonic() + 60.0
    while True:
        try:
            return opened(bus, session=session, mapper=mapper)
        except ConflictError:
            assert time.monotonic() < deadline
            time.sleep(0.1)
