"""A mapper whose disk refuses every write: its log, its snapshots, its leases."""

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from benchmarks.aftermath import difference_m
from benchmarks.cluster import wait_for
from pointslam.client import Client
from shared.errors import StorageError

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(sys.platform != "linux", reason="limits of another process need Linux"),
]


@contextmanager
def no_room_to_write(pid: int) -> Iterator[None]:
    """No file of a process may grow or be written to; the kernel refuses with EFBIG."""
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, before)


@pytest.fixture
def client(cluster):
    with Client(cluster.url) as client:
        yield client


@pytest.fixture
def session(client, recording, request):
    """Of one of both modes, with its first frames."""
    T_first = recording.frame(0).T_world_camera
    session = client.create_session(recording.calibration, mode=request.param, T_map_first=T_first)
    for seq in range(12):
        track(session, recording, seq)
    session.wait_until_mapped()
    yield session
    session.delete()


def track(session, recording, seq):
    image = recording.frame(seq)
    return session.track(image.rgb, image.depth, image.t_ns)


@pytest.mark.parametrize("session", ["offline"], indirect=True)
def test_a_frame_that_cannot_be_logged_is_refused_and_may_come_again(
    cluster, session, recording, undisturbed
):
    mapper = cluster.process(session.info()["mapper"])

    with no_room_to_write(mapper.pid):
        with pytest.raises(StorageError):
            track(session, recording, 12)
        time.sleep(3.0)  # longer than its lease, which cannot be renewed either
    for seq in range(12, 20):
        track(session, recording, seq)

    told = {r.seq: r.T_map_camera_online for r in session.trajectory()}
    assert list(told) == list(range(20))
    assert difference_m(told, undisturbed) < 0.001
    assert cluster.is_whole()


def is_told(replies):
    """Whether a reply says that the map cannot be written."""
    problems = [reply.map_problem for reply in replies if reply.map_problem is not None]
    return StorageError.code in {problem.code for problem in problems}


@pytest.mark.parametrize("session", ["live"], indirect=True)
def test_a_live_client_is_told_and_tracked_on(cluster, session, recording):
    mapper = cluster.process(session.info()["mapper"])

    with no_room_to_write(mapper.pid):
        replies = [track(session, recording, 12)]
        while not is_told(replies) and len(replies) < 27:  # the recording has 40 frames
            replies.append(track(session, recording, 12 + len(replies)))
    session.wait_until_mapped()
    wait_for(lambda: session.info()["tracking"]["undelivered"] == 0)
    after = track(session, recording, 12 + len(replies))

    assert {reply.status for reply in replies} == {"TRACKED"}
    assert is_told(replies)
    assert after.map_problem is None
    assert [record.seq for record in session.trajectory()] == list(range(13 + len(replies)))
    assert cluster.is_whole()
