"""Frame streams over WebSocket: order, credit, superseding, what live and offline promise."""

import time

import pytest

from pointslam.client import Client
from shared.errors import UnavailableError
from shared.frames import TrackingStatus

SECOND = 1_000_000_000


def frames(session, rgb, depth, count, pause_s=0.0):
    for i in range(count):
        time.sleep(pause_s)
        yield session.frame(rgb, depth, (i + 1) * SECOND)


def slow_down(trackers, delay_s):
    for tracker in trackers:
        tracker.delay_s = delay_s


def test_every_frame_of_an_offline_stream_is_tracked_in_order(offline, rgb, depth):
    replies = list(offline.stream(frames(offline, rgb, depth, 40)))

    assert [reply.seq for reply in replies] == list(range(40))
    assert {reply.status for reply in replies} == {TrackingStatus.TRACKED}


def test_a_live_stream_supersedes_all_but_the_newest_and_answers_in_order(
    live, trackers, rgb, depth
):
    slow_down(trackers, 0.1)

    replies = list(live.stream(frames(live, rgb, depth, 20, pause_s=0.01)))

    statuses = [reply.status for reply in replies]
    assert [reply.seq for reply in replies] == list(range(20))
    assert statuses[0] is statuses[-1] is TrackingStatus.TRACKED
    assert statuses.count(TrackingStatus.SUPERSEDED) >= 10


def test_superseded_frames_never_reach_the_map(gateway, live, trackers, rgb, depth):
    slow_down(trackers, 0.1)
    replies = list(live.stream(frames(live, rgb, depth, 10, pause_s=0.01)))
    live.wait_until_mapped()

    recorded = [entry.record.seq for entry in gateway.mapper.disk[live.name].entries]

    assert recorded == [r.seq for r in replies if r.status is TrackingStatus.TRACKED]


def test_a_stream_goes_on_after_a_refused_frame(offline, rgb, depth):
    good = [offline.frame(rgb, depth, (i + 1) * SECOND) for i in range(3)]

    replies = list(offline.stream([good[0], good[0], good[1], good[2]]))

    assert [reply.error and reply.error.field for reply in replies] == [None, "seq", None, None]


def test_an_error_of_the_frames_source_reaches_the_caller(offline, rgb, depth):
    def broken():
        yield from frames(offline, rgb, depth, 2)
        raise ValueError("the disk is gone")

    with pytest.raises(ValueError, match="disk"):
        list(offline.stream(broken()))


def test_a_second_stream_continues_the_numbers(client, offline, rgb, depth):
    list(offline.stream(frames(offline, rgb, depth, 5)))

    again = client.session(offline.name)
    reply = again.track(rgb, depth, 100 * SECOND)

    assert reply.seq == 5


def test_a_stream_that_is_left_early_hurts_nobody(offline, rgb, depth):
    stream = offline.stream(frames(offline, rgb, depth, 100))
    next(stream)
    stream.close()
    time.sleep(0.2)

    assert offline.track(rgb, depth, 1000 * SECOND).status is TrackingStatus.TRACKED


def test_a_gateway_that_is_not_there_is_unavailable(offline, rgb, depth):
    with Client("http://127.0.0.1:9") as nowhere:
        assert not nowhere.ready()
        with pytest.raises(UnavailableError, match="does not answer"):
            nowhere.sessions()
