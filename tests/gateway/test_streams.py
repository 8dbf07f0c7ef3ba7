"""Frame streams over WebSocket: order, credit, superseding, what live and offline promise."""

import dataclasses
import re

import httpx
import msgpack
import pytest

from benchmarks.cluster import wait_for
from pointslam.client import Client
from pointslam.client.frame_stream import open_stream
from shared import codec
from shared.errors import UnavailableError
from shared.frames import ColourImage, TrackingStatus
from shared.stream import FrameReply

SECOND = 1_000_000_000


def frames(session, rgb, depth, count):
    for i in range(count):
        yield session.frame(rgb, depth, (i + 1) * SECOND)


def frames_before_the_first_answer(session, gateway, rgb, depth, count):
    """All but the first and the last are superseded; to be used with `trackers`."""
    before = superseded(gateway)
    for tracker in gateway.trackers:
        tracker.may_answer.clear()
    yield from frames(session, rgb, depth, count)
    wait_for(lambda: superseded(gateway) == before + count - 2)
    for tracker in gateway.trackers:
        tracker.may_answer.set()


def superseded(gateway):
    page = httpx.get(f"{gateway.url}/metrics").text
    count = re.search(r'pointslam_frames_total\{outcome="SUPERSEDED"\} (\S+)', page)
    return float(count[1]) if count else 0.0


def test_every_frame_of_an_offline_stream_is_tracked_in_order(offline, rgb, depth):
    replies = list(offline.stream(frames(offline, rgb, depth, 40)))

    assert [reply.seq for reply in replies] == list(range(40))
    assert {reply.status for reply in replies} == {TrackingStatus.TRACKED}


def test_a_live_stream_supersedes_all_but_the_newest_and_answers_in_order(
    gateway, live, trackers, rgb, depth
):
    replies = list(live.stream(frames_before_the_first_answer(live, gateway, rgb, depth, 20)))

    statuses = [reply.status for reply in replies]
    assert [reply.seq for reply in replies] == list(range(20))
    assert statuses[0] is statuses[-1] is TrackingStatus.TRACKED
    assert set(statuses[1:-1]) == {TrackingStatus.SUPERSEDED}


def test_superseded_frames_never_reach_the_map(gateway, live, trackers, rgb, depth):
    list(live.stream(frames_before_the_first_answer(live, gateway, rgb, depth, 10)))
    live.wait_until_mapped()

    recorded = [entry.record.seq for entry in gateway.mapper.disk[live.name].entries]

    assert recorded == [0, 9]


def test_a_stream_goes_on_after_a_refused_frame(offline, rgb, depth):
    good = [offline.frame(rgb, depth, (i + 1) * SECOND) for i in range(3)]

    replies = list(offline.stream([good[0], good[0], good[1], good[2]]))

    assert [reply.error and reply.error.field for reply in replies] == [None, "seq", None, None]


def with_rgb(message, data):
    return dataclasses.replace(message, rgb=ColourImage(message.rgb.encoding, data))


@pytest.mark.parametrize("image", [b"", b"\xff\xd8 no image", None])
def test_a_damaged_image_is_answered_with_its_frames_numbers(offline, rgb, depth, image):
    good = [offline.frame(rgb, depth, (i + 1) * SECOND) for i in range(3)]
    damaged = with_rgb(good[1], good[1].rgb.bytes[:-400] if image is None else image)

    replies = list(offline.stream([good[0], damaged, good[2]]))

    assert [(reply.seq, reply.t_ns) for reply in replies] == [(m.seq, m.t_ns) for m in good]
    assert [reply.error and reply.error.field for reply in replies] == [None, "rgb.bytes", None]


SPOILT = {
    "a field too many": lambda fields: {**fields, "speed": 3.0},
    "a field too few": lambda fields: {k: v for k, v in fields.items() if k != "depth"},
    "an unknown encoding": lambda fields: {**fields, "rgb": {"encoding": "bmp", "bytes": b""}},
    "fields in another order": lambda fields: dict(sorted(fields.items()), rgb=None),
    "images too large": lambda fields: {
        **fields,
        "rgb": {"encoding": "png", "bytes": bytes(10**6)},
    },
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_message_that_is_no_frame_is_answered_with_its_numbers(
    gateway, offline, rgb, depth, case
):
    fields = codec.to_plain(offline.frame(rgb, depth, 7 * SECOND))

    reply = answer(gateway, offline, msgpack.packb(SPOILT[case](fields)))

    assert reply.error is not None
    assert (reply.seq, reply.t_ns) == (fields["seq"], 7 * SECOND)


def test_a_message_cut_short_is_answered_with_what_came(gateway, offline, rgb, depth):
    data = codec.pack(offline.frame(rgb, depth, 7 * SECOND))

    reply = answer(gateway, offline, data[: len(data) // 2])

    assert (reply.seq, reply.t_ns) == (0, 7 * SECOND)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x91" * 5000, msgpack.packb({"seq": "one"})])
def test_a_message_without_numbers_is_answered_all_the_same(gateway, offline, data):
    reply = answer(gateway, offline, data)

    assert reply.error is not None
    assert (reply.seq, reply.t_ns) == (-1, -1)


def answer(gateway, session, data):
    url = f"{gateway.url.replace('http', 'ws')}/v1/sessions/{session.name}/stream"
    with open_stream(url) as connection:
        connection.send(data)
        return codec.unpack(FrameReply, connection.recv(decode=False))


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

    assert offline.track(rgb, depth, 1000 * SECOND).status is TrackingStatus.TRACKED


def test_a_gateway_that_is_not_there_is_unavailable(offline, rgb, depth):
    with Client("http://127.0.0.1:9") as nowhere:
        assert not nowhere.ready()
        with pytest.raises(UnavailableError, match="does not answer"):
            nowhere.sessions()
