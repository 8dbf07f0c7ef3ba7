"""Workers and mappers that go away, freeze and come back, on the real bus."""

import os
import signal
import threading
from contextlib import ExitStack

import numpy as np
import pytest

from benchmarks.cluster import wait_for
from benchmarks.local_gateway import (
    PATIENCE,
    PATIENT_BUS,
    PATIENT_ROUTER,
    free_port,
    gateway_process,
    local_gateway,
)
from benchmarks.stand_ins import StandInMapper, StandInTracker
from pointslam.client import Client
from shared.bus import open_bus, open_router
from shared.errors import UnavailableError
from shared.frames import TrackingStatus

SECOND = 1_000_000_000
SETTINGS = (
    *PATIENCE,
    "dispatch.patience_s=0.5",
    "dispatch.quarantine_s=60.0",
    "dispatch.live_wait_s=0.5",
    "drain_s=60.0",
)


@pytest.fixture
def gateway():
    with local_gateway(2, *SETTINGS) as running:
        yield running
        for tracker in running.trackers:
            tracker.may_answer.set()


@pytest.fixture
def client(gateway):
    with Client(gateway.url) as client:
        wait_for(client.ready)
        yield client


@pytest.fixture
def session(client, calibration):
    return client.create_session(calibration, mode="offline")


def used(gateway, session):
    """The tracker that answers this session, then the other."""
    asked = [any(r.session == session.name for r in t.requests) for t in gateway.trackers]
    return gateway.trackers if asked[0] else gateway.trackers[::-1]


def test_a_session_stays_with_its_tracker(gateway, session, rgb, depth):
    for i in range(10):
        session.track(rgb, depth, (i + 1) * SECOND)

    asked, other = used(gateway, session)
    assert (len(asked.requests), len(other.requests)) == (10, 0)


def test_a_frozen_tracker_is_left_alone_and_its_frame_goes_to_another(gateway, session, rgb, depth):
    session.track(rgb, depth, SECOND)
    frozen, other = used(gateway, session)
    frozen.may_answer.clear()

    replies = [session.track(rgb, depth, (i + 2) * SECOND) for i in range(5)]

    assert {reply.status for reply in replies} == {TrackingStatus.TRACKED}
    assert [request.frame.seq for request in other.requests] == [1, 2, 3, 4, 5]
    assert [request.frame.seq for request in frozen.requests] == [0, 1]


def test_the_trajectory_does_not_depend_on_the_tracker(gateway, session, rgb, depth):
    session.track(rgb, depth, SECOND)
    used(gateway, session)[0].may_answer.clear()

    session.track(rgb, depth, 2 * SECOND)

    np.testing.assert_allclose([T[0, 3] for _, T in session.poses()], [0.0, 0.01], atol=1e-12)


def test_a_tracker_that_goes_away_is_replaced_at_once(gateway, session, rgb, depth):
    session.track(rgb, depth, SECOND)
    gone, other = used(gateway, session)
    gone.leave()

    reply = session.track(rgb, depth, 2 * SECOND)

    assert reply.status is TrackingStatus.TRACKED
    assert [request.frame.seq for request in other.requests] == [1]


def test_without_a_tracker_a_live_frame_is_unavailable_and_may_come_again(
    gateway, client, calibration, rgb, depth
):
    session = client.create_session(calibration, mode="live")
    for tracker in gateway.trackers:
        tracker.leave()

    with pytest.raises(UnavailableError, match="no tracking worker"):
        session.track(rgb, depth, SECOND)

    assert not client.ready()
    with open_bus([gateway.router], PATIENT_BUS) as bus:
        StandInTracker(bus, "tracker-9")
        wait_for(client.ready)
        assert session.track(rgb, depth, SECOND).seq == 0


def test_a_gateway_that_starts_again_takes_the_session_up(gateway, session, rgb, depth):
    for i in range(12):
        session.track(rgb, depth, (i + 1) * SECOND)
    ports = (free_port(), free_port())

    with (
        gateway_process(gateway.router, ports),
        Client(f"http://127.0.0.1:{ports[0]}") as client,
    ):
        wait_for(client.ready)
        reply = client.session(session.name).track(rgb, depth, 100 * SECOND)

    assert (reply.seq, reply.reference_seq) == (12, 10)
    assert len(gateway.mapper.disk[session.name].entries) == 13


def test_a_gateway_that_ends_finishes_what_is_in_flight(gateway, client, session, rgb, depth):
    session.track(rgb, depth, SECOND)
    for tracker in gateway.trackers:
        tracker.may_answer.clear()
    replies = []
    sender = threading.Thread(
        target=lambda: replies.append(session.track(rgb, depth, 2 * SECOND)), daemon=True
    )
    sender.start()
    wait_for(lambda: any(len(tracker.requests) == 2 for tracker in gateway.trackers))

    os.kill(gateway.pid, signal.SIGTERM)
    wait_for(lambda: not client.ready())
    for tracker in gateway.trackers:
        tracker.may_answer.set()
    sender.join(60.0)

    assert [reply.seq for reply in replies] == [1]


def test_entries_that_a_gone_mapper_did_not_take_go_to_the_next_owner(gateway, session, rgb, depth):
    for i in range(3):
        session.track(rgb, depth, (i + 1) * SECOND)
    disk = gateway.mapper.disk
    with open_bus([gateway.router], PATIENT_BUS) as bus:
        gateway.mapper.leave()
        StandInMapper(bus, "mapper-1", disk)

        replies = [session.track(rgb, depth, (i + 4) * SECOND) for i in range(3)]

        assert [reply.seq for reply in replies] == [3, 4, 5]
        assert session.info()["mapper"] == "mapper-1"
        assert [e.record.seq for e in disk[session.name].entries] == list(range(6))


def test_a_session_whose_mapper_was_gone_before_it_could_say_so_is_there_all_the_same(
    gateway, client, calibration
):
    created = []
    with open_bus([gateway.router], PATIENT_BUS) as bus:
        mappers = (gateway.mapper, StandInMapper(bus, "mapper-1", gateway.mapper.disk))
        wait_for(lambda: client.sessions() == [] and mappers[1].was_asked.is_set())
        for mapper in mappers:
            mapper.may_answer.clear()
        creating = threading.Thread(
            target=lambda: created.append(client.create_session(calibration))
        )
        creating.start()
        wait_for(lambda: any(mapper.opened for mapper in mappers))
        gone, other = sorted(mappers, key=lambda mapper: not mapper.opened)

        gone.leave()
        for mapper in mappers:
            mapper.may_answer.set()
        creating.join(60.0)

        info = created[0].info()
        assert (info["mapper"], info["epoch"]) == (other.name, 2)


def test_a_session_is_deleted_by_a_mapper_that_comes_after_the_one_that_was_gone(
    gateway, client, session
):
    disk = gateway.mapper.disk
    gateway.mapper.leave()
    deleting = threading.Thread(target=session.delete)
    deleting.start()
    with open_bus([gateway.router], PATIENT_BUS) as bus:
        StandInMapper(bus, "mapper-1", disk)
        deleting.join(60.0)

    assert disk == {}


def test_a_live_session_holds_its_frames_while_the_map_has_no_owner(
    gateway, client, calibration, rgb, depth
):
    session = client.create_session(calibration, mode="live")
    session.track(rgb, depth, SECOND)
    session.wait_until_mapped()
    disk = gateway.mapper.disk
    gateway.mapper.leave()

    replies = []
    while len(replies) < 3 or replies[-1].map_problem is None:
        replies.append(session.track(rgb, depth, (len(replies) + 2) * SECOND))

    assert {reply.status for reply in replies} == {TrackingStatus.TRACKED}
    assert "no owner" in replies[-1].map_problem.reason
    with open_bus([gateway.router], PATIENT_BUS) as bus:
        StandInMapper(bus, "mapper-1", disk)
        session.wait_until_mapped()
        assert session.track(rgb, depth, 1000 * SECOND).map_problem is None
        session.wait_until_mapped()
        recorded = [entry.record.seq for entry in disk[session.name].entries]
        assert recorded == list(range(len(replies) + 2))


def test_a_router_that_starts_again_brings_everything_back(calibration, rgb, depth):
    port = free_port()
    router = open_router(f"tcp/127.0.0.1:{port}", PATIENT_ROUTER)
    endpoint, ports = f"tcp/127.0.0.1:{port}", (free_port(), free_port())
    with ExitStack() as stack:
        StandInTracker(stack.enter_context(open_bus([endpoint], PATIENT_BUS)), "tracker-0")
        StandInMapper(stack.enter_context(open_bus([endpoint], PATIENT_BUS)), "mapper-0")
        stack.enter_context(gateway_process(endpoint, ports))
        client = stack.enter_context(Client(f"http://127.0.0.1:{ports[0]}"))
        wait_for(client.ready)
        session = client.create_session(calibration, mode="offline")
        session.track(rgb, depth, SECOND)

        router.close()
        wait_for(lambda: not client.ready())
        stack.callback(open_router(endpoint, PATIENT_ROUTER).close)

        assert session.track(rgb, depth, 2 * SECOND).status is TrackingStatus.TRACKED
        assert session.info()["epoch"] == 1


def test_beside_a_silent_tracker_another_is_asked_long_before_the_time_out(
    gateway, client, calibration, rgb, depth
):
    session = client.create_session(calibration, mode="live")
    session.track(rgb, depth, SECOND)
    frozen, other = used(gateway, session)
    frozen.may_answer.clear()

    replies = [session.track(rgb, depth, (i + 2) * SECOND) for i in range(3)]

    assert {reply.status for reply in replies} == {TrackingStatus.TRACKED}
    assert [request.frame.seq for request in other.requests] == [1, 2, 3]
    assert [request.frame.seq for request in frozen.requests] == [0, 1]


def test_a_slow_answer_of_the_only_tracker_is_waited_for(gateway, client, calibration, rgb, depth):
    slow, gone = gateway.trackers
    gone.leave()
    slow.delay_s = 0.7  # longer than anybody's patience

    session = client.create_session(calibration, mode="live")
    replies = [session.track(rgb, depth, (i + 1) * SECOND) for i in range(3)]

    assert {reply.status for reply in replies} == {TrackingStatus.TRACKED}
    assert [request.frame.seq for request in slow.requests] == [0, 1, 2]
