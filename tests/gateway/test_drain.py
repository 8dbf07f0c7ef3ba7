"""A gateway that is asked to end lets its frame streams go with every reply delivered."""

import os
import signal
from collections.abc import Iterator

import grpc
import httpx
import pytest

from benchmarks.cluster import wait_for
from benchmarks.local_gateway import PATIENCE, local_gateway
from pointslam.client import Client
from shared.errors import UnavailableError
from shared.stream import FrameMessage
from shared.wire import tracking_service_pb2 as wire
from shared.wire import tracking_service_pb2_grpc as wire_grpc

SECOND = 1_000_000_000
SETTINGS = (*PATIENCE, "drain_notice_s=0.0", "drain_streams_s=60.0")
PATIENCE_S = 60.0


@pytest.fixture
def gateway():
    with local_gateway(1, *SETTINGS) as running:
        yield running
        running.trackers[0].may_answer.set()


@pytest.fixture
def session(gateway, calibration):
    with Client(gateway.url) as client:
        wait_for(client.ready)
        yield client.create_session(calibration, mode="live")


def frames_around_the_end(gateway, messages) -> Iterator[FrameMessage]:
    """Three frames of which the second is superseded, and one more when the gateway is ending."""
    tracker = gateway.trackers[0]
    tracker.may_answer.clear()
    yield messages[0]
    wait_for(lambda: len(tracker.requests) == 1)
    yield from messages[1:3]
    wait_for(lambda: has_superseded(gateway))
    os.kill(gateway.pid, signal.SIGTERM)
    wait_for(lambda: not is_ready(gateway))
    tracker.may_answer.set()
    yield messages[3]


def has_superseded(gateway) -> bool:
    return 'outcome="SUPERSEDED"' in httpx.get(f"{gateway.url}/metrics").text


def is_ready(gateway) -> bool:
    return httpx.get(f"{gateway.url}/readyz").status_code == 200


def over_websocket(gateway, session, frames):
    yield from session.stream(frames)


def over_grpc(gateway, session, frames):
    with grpc.insecure_channel(gateway.grpc_address) as channel:
        stub = wire_grpc.TrackingServiceStub(channel)
        requests = (request_of(session.name, message) for message in frames)
        try:
            yield from stub.TrackFrames(requests, timeout=PATIENCE_S)
        except grpc.RpcError as error:
            assert error.code() is grpc.StatusCode.UNAVAILABLE
            raise UnavailableError(error.details()) from None


def request_of(name, message):
    rgb, depth = message.rgb, message.depth
    colour = f"COLOUR_ENCODING_{rgb.encoding.name}"
    raw = f"DEPTH_ENCODING_{depth.encoding.name}"
    frame = wire.Frame(
        seq=message.seq,
        t_ns=message.t_ns,
        rgb=wire.ColourImage(encoding=colour, bytes=rgb.bytes),
        depth=wire.DepthImage(encoding=raw, bytes=depth.bytes),
    )
    return wire.TrackFramesRequest(session_id=name, frame=frame)


@pytest.mark.parametrize("stream", [over_websocket, over_grpc])
def test_frames_that_were_taken_are_answered_before_the_stream_ends(
    gateway, session, rgb, depth, stream
):
    messages = [session.frame(rgb, depth, (i + 1) * SECOND) for i in range(4)]
    seqs = []

    with pytest.raises(UnavailableError, match="connect again"):
        for reply in stream(gateway, session, frames_around_the_end(gateway, messages)):
            seqs.append(reply.seq)

    assert seqs == [0, 1, 2]
