"""Clients that watch a session: found in its map and followed, without a trace in it."""

import asyncio
import dataclasses
import threading

import grpc
import numpy as np
import pytest
from websockets.sync.client import connect

from benchmarks.cluster import wait_for
from pointslam.client import AsyncClient
from pointslam.client.calls import watch_url
from shared import codec
from shared.camera import Camera
from shared.errors import NotFoundError
from shared.frames import ColourEncoding, TrackingStatus
from shared.images import encode_jpeg
from shared.stream import FrameReply
from shared.wire import tracking_service_pb2, tracking_service_pb2_grpc, types_pb2

SECOND = 1_000_000_000


def frames(session, rgb, depth, seqs):
    for seq in seqs:
        session.next_seq = seq
        yield session.frame(rgb, depth, (seq + 1) * SECOND)


def streamed(session, rgb, depth, seqs):
    return list(session.stream(frames(session, rgb, depth, seqs)))


def watched(client, session, rgb, depth, seqs):
    return list(client.session(session.name).watch(frames(session, rgb, depth, seqs)))


@pytest.mark.parametrize("session", ["offline", "live"], indirect=True)
def test_a_watcher_gets_poses_and_leaves_nothing(gateway, client, session, rgb, depth):
    streamed(session, rgb, depth, range(3))
    session.wait_until_mapped()
    before = [record.seq for record in session.trajectory()]

    replies = watched(client, session, rgb, depth, range(100, 103))

    assert [(r.seq, r.status, r.keyframe) for r in replies][0] == (100, "TRACKED", False)
    assert replies[-1].T_map_camera is not None
    assert [record.seq for record in session.trajectory()] == before
    assert [entry.record.seq for entry in gateway.mapper.disk[session.name].entries] == before
    assert session.info()["tracking"]["last_seq"] == 2


@pytest.fixture
def session(client, calibration, request):
    session = client.create_session(calibration, mode=getattr(request, "param", "offline"))
    yield session
    session.delete()


def test_a_watcher_starts_without_a_prior_and_goes_on_with_its_own(
    gateway, client, session, rgb, depth
):
    streamed(session, rgb, depth, range(3))

    watched(client, session, rgb, depth, [50, 51])

    asked = [r for t in gateway.trackers for r in t.requests if r.session == session.name]
    known = {request.frame.seq: request.prior for request in asked}
    assert known[50] is None
    assert known[51] is not None and known[51].seq == 50


def test_two_watch_while_the_first_streams_on_and_nobody_waits_for_another(
    client, session, rgb, depth
):
    found = {}

    def watch(start):
        found[start] = watched(client, client.session(session.name), rgb, depth, range(start, 620))

    threads = [threading.Thread(target=watch, args=(start,)) for start in (600, 610)]
    for thread in threads:
        thread.start()
    replies = streamed(session, rgb, depth, range(20))
    for thread in threads:
        thread.join(60.0)

    assert [reply.seq for reply in replies] == list(range(20))
    assert {start: len(all_) for start, all_ in found.items()} == {600: 20, 610: 10}
    assert [record.seq for record in session.trajectory()] == list(range(20))


def test_a_watcher_that_is_not_found_has_no_pose(client, session, trackers, rgb, depth):
    for tracker in trackers:
        tracker.status = TrackingStatus.LOST

    (reply,) = watched(client, session, rgb, depth, [7])

    assert (reply.status, reply.T_map_camera) == ("LOST", None)


def test_a_watcher_may_have_another_device(gateway, client, session, calibration, depth):
    large = dataclasses.replace(calibration.colour.intrinsics, width=80)
    device = dataclasses.replace(calibration, colour=Camera(large), depth=calibration.colour)
    image = encode_jpeg(np.zeros((48, 80, 3), np.uint8))

    (reply,) = client.session(session.name).watch([session.frame(image, depth, SECOND)], device)

    asked = [r for t in gateway.trackers for r in t.requests if r.session == session.name]
    assert reply.error is None
    assert image.encoding is ColourEncoding.JPEG
    assert asked[-1].calibration.colour.intrinsics.width == 80


@pytest.mark.parametrize(
    ("text", "field"), [("{}", "calibration"), ("no JSON", "message"), ("x" * 9999, "message")]
)
def test_a_device_that_is_none_is_refused_by_field(gateway, session, text, field):
    with connect(watch_url(gateway.url, session.name), compression=None) as connection:
        connection.send(text)
        reply = codec.unpack(FrameReply, connection.recv(decode=False))

    assert reply.error is not None
    assert reply.error.field == field


def test_watchers_are_counted_and_gone_when_their_sockets_are(gateway, session):
    with connect(watch_url(gateway.url, session.name), compression=None):
        wait_for(lambda: session.info()["tracking"]["watchers"] == 1)

    wait_for(lambda: session.info()["tracking"]["watchers"] == 0)


def test_who_watches_a_session_that_is_deleted_is_told(client, calibration, rgb, depth):
    session = client.create_session(calibration, mode="offline")
    deleted = threading.Event()

    def two():
        yield session.frame(rgb, depth, SECOND)
        deleted.wait(60.0)
        yield session.frame(rgb, depth, 2 * SECOND)

    replies = client.session(session.name).watch(two())
    first = next(replies)
    session.delete()
    deleted.set()

    assert first.error is None
    assert [reply.error.code for reply in replies] == ["unavailable"]


def test_a_session_that_there_is_not_cannot_be_watched(client, session, rgb, depth):
    other = client.session(session.name)
    other.name = "nobody"

    with pytest.raises(NotFoundError):
        next(other.watch(frames(session, rgb, depth, [0])))


def test_the_asynchronous_client_watches_too(gateway, session, calibration, rgb, depth):
    async def run():
        async def messages():
            for message in frames(session, rgb, depth, [4, 5]):
                yield message

        async with AsyncClient(gateway.url) as client:
            same = await client.session(session.name)
            return [reply async for reply in same.watch(messages(), calibration)]

    replies = asyncio.run(run())

    assert [(reply.seq, reply.status) for reply in replies] == [(4, "TRACKED"), (5, "TRACKED")]


def test_frames_are_watched_over_grpc(gateway, session, rgb, depth):
    message = next(frames(session, rgb, depth, [9]))
    frame = tracking_service_pb2.Frame(
        seq=message.seq,
        t_ns=message.t_ns,
        rgb=tracking_service_pb2.ColourImage(
            encoding=tracking_service_pb2.COLOUR_ENCODING_JPEG, bytes=message.rgb.bytes
        ),
        depth=tracking_service_pb2.DepthImage(
            encoding=tracking_service_pb2.DEPTH_ENCODING_PNG16, bytes=message.depth.bytes
        ),
    )
    request = tracking_service_pb2.WatchFramesRequest(session_id=session.name, frame=frame)

    with grpc.insecure_channel(gateway.grpc_address) as channel:
        stub = tracking_service_pb2_grpc.TrackingServiceStub(channel)
        (answer,) = stub.WatchFrames(iter([request]))

    assert answer.reply.status == types_pb2.TRACKING_STATUS_TRACKED
    assert session.trajectory() == []


def test_of_two_streams_of_one_session_the_newer_one_advances_it(client, session, rgb, depth):
    newer_began = threading.Event()

    def older():
        yield from frames(session, rgb, depth, [0])
        newer_began.wait(60.0)
        yield session.frame(rgb, depth, 3 * SECOND)

    replies = session.stream(older())
    first = next(replies)
    (second,) = streamed(client.session(session.name), rgb, depth, [1])
    newer_began.set()

    assert (first.error, second.error) == (None, None)
    assert [reply.error.code for reply in replies] == ["claim_lost"]
