"""Several gateways before the same sessions: real processes, clients that move between them."""

import threading
import time
from contextlib import ExitStack

import numpy as np
import pytest

from benchmarks.cluster import wait_for
from benchmarks.local_gateway import (
    PATIENCE,
    PATIENT_BUS,
    free_port,
    gateway_process,
    local_gateway,
)
from pointslam.client import Client
from shared.bus import Keys, open_bus
from shared.errors import ClaimLostError
from shared.tracks import AdvanceReply, ClaimReply, ClaimRequest

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def gateways():
    """One router, two trackers, one mapper; clients of two gateways."""
    with ExitStack() as stack:
        first = stack.enter_context(local_gateway(2, *PATIENCE))
        ports = (free_port(), free_port())
        settings = (*PATIENCE, "session_idle_s=1.0")
        stack.enter_context(gateway_process(first.router, ports, *settings))
        clients = [
            stack.enter_context(Client(url)) for url in (first.url, f"http://127.0.0.1:{ports[0]}")
        ]
        for client in clients:
            wait_for(client.ready)
        yield first, clients


def priors(gateway, session):
    """What the trackers were told of the last pose, by frame number."""
    asked = [r for t in gateway.trackers for r in t.requests if r.session == session]
    return {r.frame.seq: r.prior for r in asked}


def stream(session, rgb, depth, seqs):
    session.next_seq = seqs[0]
    frames = [session.frame(rgb, depth, (seq + 1) * SECOND) for seq in seqs]
    return list(session.stream(frames))


@pytest.mark.parametrize("mode", ["offline", "live"])
def test_a_session_goes_there_and_back_and_no_gateway_works_from_what_is_stale(
    gateways, calibration, rgb, depth, mode
):
    gateway, (here, there) = gateways
    session = here.create_session(calibration, mode=mode)
    same = there.session(session.name)

    replies = []
    for client_session, seqs in ((session, [0, 1]), (same, [2, 3]), (session, [4, 5])):
        for seq in seqs:
            replies += stream(client_session, rgb, depth, [seq])

    assert [reply.error for reply in replies] == [None] * 6
    known = priors(gateway, session.name)
    assert [known[seq].seq for seq in range(1, 6)] == [0, 1, 2, 3, 4]
    session.wait_until_mapped()
    assert [record.seq for record in session.trajectory()] == [0, 1, 2, 3, 4, 5]


def test_a_frame_elsewhere_starts_from_the_very_prior_that_it_would_have_had(
    gateways, calibration, rgb, depth
):
    gateway, (here, there) = gateways
    moving, staying = (here.create_session(calibration, mode="offline") for _ in range(2))

    for seq in range(4):
        client = (here, there)[seq % 2]
        session = client.session(moving.name)
        session.track(rgb, depth, (seq + 1) * SECOND)
        staying.track(rgb, depth, (seq + 1) * SECOND)

    moved, stayed = priors(gateway, moving.name)[3], priors(gateway, staying.name)[3]
    np.testing.assert_array_equal(moved.T_before_last, stayed.T_before_last)
    assert moved.frame_digest == stayed.frame_digest is not None
    assert (moved.seq, moved.before_last_dt_ns) == (stayed.seq, stayed.before_last_dt_ns)


def test_a_stream_whose_session_went_elsewhere_is_told_so(gateways, calibration, rgb, depth):
    _, (here, there) = gateways
    session = here.create_session(calibration, mode="offline")
    went = threading.Event()

    def frames():
        yield session.frame(rgb, depth, SECOND)
        went.wait(60.0)
        yield session.frame(rgb, depth, 3 * SECOND)

    replies = session.stream(frames())
    first = next(replies)
    there.session(session.name).track(rgb, depth, 2 * SECOND)
    went.set()

    assert first.error is None
    assert [reply.error.code for reply in replies] == ["claim_lost"]


def test_poses_are_heard_of_at_every_gateway(gateways, calibration, rgb, depth):
    _, (here, there) = gateways
    session = here.create_session(calibration, mode="live")
    elsewhere = there.session(session.name)

    for seq in range(3):
        session.track(rgb, depth, (seq + 1) * SECOND)

    wait_for(lambda: elsewhere.info()["tracking"]["last_seq"] == 2)
    np.testing.assert_allclose(elsewhere.pose()[0, 3], 0.02, atol=1e-12)


def test_a_session_that_nobody_uses_is_taken_up_again_as_it_was(gateways, calibration, rgb, depth):
    gateway, (_, there) = gateways  # this gateway forgets after a second
    session = there.create_session(calibration, mode="offline")
    for seq in range(2):
        session.track(rgb, depth, (seq + 1) * SECOND)

    time.sleep(1.6)
    session.track(rgb, depth, 3 * SECOND)

    assert priors(gateway, session.name)[2].seq == 1


def test_the_owner_takes_frames_of_the_newest_claim_only(gateways, calibration, rgb, depth):
    gateway, (here, _) = gateways
    session = here.create_session(calibration, mode="offline")
    session.track(rgb, depth, SECOND)
    entry = gateway.mapper.disk[session.name].entries[-1]
    with open_bus([gateway.router], PATIENT_BUS) as bus:
        key = Keys.session(session.name, 1, "claim")
        claim = bus.query(key, ClaimRequest("other"), ClaimReply, 60.0)

        with pytest.raises(ClaimLostError):
            bus.query(Keys.session(session.name, 1, "advance"), entry, AdvanceReply, 60.0)

    assert claim.number == entry.claim + 1


@pytest.fixture
def doomed(calibration):
    """A session at the first gateway of two, that gateway's process, and the one behind both."""
    with ExitStack() as stack:
        other = stack.enter_context(local_gateway(1, *PATIENCE))
        ports = (free_port(), free_port())
        process = stack.enter_context(gateway_process(other.router, ports, *PATIENCE))
        urls = (f"http://127.0.0.1:{ports[0]}", other.url)
        client = stack.enter_context(Client(urls))
        wait_for(lambda: client.ready() and client.url == urls[0])
        session = client.create_session(calibration, mode="offline")
        yield client, session, process, other


def kill_amid(process, stream, frames):
    """All replies of a stream whose gateway dies when some frames are answered, before the last."""
    is_killed = threading.Event()

    def gated():
        yield from frames[:-1]
        is_killed.wait(60.0)
        yield frames[-1]

    for reply in stream(gated()):
        if reply.seq == frames[5].seq:
            process.kill()
            process.wait(60.0)
            is_killed.set()
        yield reply


def test_a_stream_goes_on_at_another_gateway_when_one_is_killed(doomed, rgb, depth):
    client, session, process, other = doomed
    frames = [session.frame(rgb, depth, (i + 1) * SECOND) for i in range(12)]

    replies = list(kill_amid(process, session.stream, frames))

    assert [reply.seq for reply in replies] == list(range(12))
    assert {str(reply.status) for reply in replies} == {"TRACKED"}
    assert client.url == other.url
    assert [record.seq for record in session.trajectory()] == list(range(12))


def test_a_watcher_is_found_again_by_another_gateway_when_one_is_killed(doomed, rgb, depth):
    client, session, process, other = doomed
    stream(session, rgb, depth, [0, 1, 2])
    frames = [session.frame(rgb, depth, (seq + 1) * SECOND) for seq in range(3, 15)]

    replies = list(kill_amid(process, session.watch, frames))

    asked = [r for r in other.trackers[0].requests if r.frame.seq > 2]
    assert [reply.seq for reply in replies] == list(range(3, 15))
    assert {str(reply.status) for reply in replies} == {"TRACKED"}
    assert client.url == other.url
    assert len([request for request in asked if request.prior is None]) == 2  # found twice
    assert [record.seq for record in session.trajectory()] == [0, 1, 2]
