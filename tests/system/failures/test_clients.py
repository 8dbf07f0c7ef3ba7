"""Clients that repeat themselves, confuse the order, or vanish without a word."""

import socket
import struct
import threading
from pathlib import Path

import pytest

from benchmarks.aftermath import difference_m
from benchmarks.cluster import wait_for
from pointslam.client import Client
from pointslam.client.calls import stream_url
from pointslam.client.frame_stream import open_stream
from pointslam.client.messages import frame_message
from shared import codec

pytestmark = pytest.mark.system

RESET = struct.pack("ii", 1, 0)  # closing sends no farewell


@pytest.fixture
def client(cluster):
    with Client(cluster.url) as client:
        yield client


def message(recording, seq):
    image = recording.frame(seq)
    return frame_message(seq, image.t_ns, image.rgb, image.depth)


def created(client, recording, mode):
    T_first = recording.frame(0).T_world_camera
    return client.create_session(recording.calibration, mode=mode, T_map_first=T_first)


def test_frames_sent_twice_or_late_are_refused_and_the_others_go_on(client, recording, undisturbed):
    session = created(client, recording, "offline")
    order = [0, 1, 1, 2, 3, 5, 4, 5, 6, 0, 7, 8, 8, 9]

    replies = list(session.stream(message(recording, seq) for seq in order))

    refused = [reply.seq for reply in replies if reply.error is not None]
    told = {r.seq: r.T_map_camera.matrix() for r in replies if r.T_map_camera is not None}
    assert [reply.seq for reply in replies] == order
    assert refused == [1, 4, 5, 0, 8]
    assert {reply.error.code for reply in replies if reply.error} == {"conflict"}
    assert difference_m(told, undisturbed) < 0.001
    assert [r.seq for r in session.trajectory()] == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    session.delete()


def vanish(url, session, recording):
    """Send two frames, read nothing, and be gone."""
    with open_stream(stream_url(url, session.name)) as connection:
        for seq in range(2):
            connection.send(codec.pack(message(recording, seq)))
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        connection.socket.shutdown(socket.SHUT_RDWR)


def test_twenty_clients_that_connect_and_vanish_leave_nothing_behind(
    cluster, client, streaming, recording
):
    gateway = cluster.process("gateway-0").pid
    with streaming():
        open_before, rss_before_mb = open_files(gateway), cluster.rss_mb("gateway-0")
        sessions = [created(client, recording, "live") for _ in range(20)]
        vanishing = [
            threading.Thread(target=vanish, args=(cluster.url, session, recording))
            for session in sessions
        ]
        for thread in vanishing:
            thread.start()
        for thread in vanishing:
            thread.join(60.0)
        for session in sessions:
            session.delete()
        wait_for(lambda: open_files(gateway) <= open_before + 2)

    assert cluster.rss_mb("gateway-0") < rss_before_mb + 30


def open_files(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))
