"""The gateway with real trackers and a real mapper: the whole way, and processes that die."""

import json
import os
import signal
import threading
from dataclasses import replace
from itertools import islice

import grpc
import httpx
import numpy as np
import pytest

from benchmarks import gateway as gateway_benchmark
from benchmarks.cluster import wait_for
from pointslam.client import Client
from pointslam.client.messages import frame_message
from pointslam.datasets import open_sequence
from pointslam.synth import Noise, SynthOptions, record_scene
from shared.camera import Intrinsics
from shared.errors import InputError
from shared.frames import DepthImage, TrackingStatus
from shared.localization import LocalizationStatus
from shared.wire import pose_service_pb2, pose_service_pb2_grpc

pytestmark = pytest.mark.system

ROOM = SynthOptions(
    num_frames=30,
    num_views=1,
    noise=Noise.NONE,
    camera=Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240),
)


@pytest.fixture(scope="module")
def room(tmp_path_factory, lit_scene):
    folder = tmp_path_factory.mktemp("synth") / "room"
    record_scene(folder, lit_scene, ROOM)
    return open_sequence(folder)


@pytest.fixture
def client(services):
    with Client(services.url) as client:
        wait_for(client.ready)
        yield client


@pytest.fixture
def session(client, room):
    session = client.create_session(room.calibration, mode="offline", T_map_first=room.truth(0))
    yield session
    session.delete()


def frames(session, room, first, end):
    for i in range(first, end):
        frame = room.frame(i)
        yield session.frame(frame.rgb, frame.depth, frame.t_ns)


def stream(session, room, first, end):
    return list(session.stream(frames(session, room, first, end)))


def errors_m(replies, room):
    return [
        float(np.linalg.norm(r.T_map_camera.matrix()[:3, 3] - room.truth(r.seq)[:3, 3]))
        for r in replies
    ]


def process(services, name):
    return next(p for p in services.processes if p.command.name == name)


def kill_and_restart(services, name):
    victim = process(services, name)
    os.kill(victim.pid, signal.SIGKILL)
    victim.wait(60.0)
    victim.restart()


def trackers(services):
    return httpx.get(f"{services.url}/readyz").json().get("trackers")


def test_a_sequence_is_tracked_mapped_and_rendered(session, room):
    replies = stream(session, room, 0, 15)
    session.wait_until_mapped()

    view = session.render(room.truth(0))
    assert {reply.status for reply in replies} == {TrackingStatus.TRACKED}
    assert max(errors_m(replies, room)) < 0.01
    assert session.info()["keyframes"] >= 2
    assert (view.alpha > 230).mean() > 0.8


def test_every_door_tells_the_same_pose(services, session, room):
    stream(session, room, 0, 3)

    with grpc.insecure_channel(f"127.0.0.1:{services.grpc_port}") as channel:
        stub = pose_service_pb2_grpc.PoseServiceStub(channel)
        pose = stub.GetPose(pose_service_pb2.GetPoseRequest(session_id=session.name)).pose

    told = httpx.get(f"{services.url}/v1/sessions/{session.name}/pose").json()
    assert pose.T_map_camera.position.x == told["T_map_camera"]["position"]["x"]
    assert pose.T_map_camera.orientation.w == told["T_map_camera"]["orientation"]["w"]


def state_of(session):
    """What a watcher must leave as it is."""
    info = session.info()
    told = [(r.seq, r.T_map_camera_online.tobytes()) for r in session.trajectory()]
    return info["frames"], info["keyframes"], info["map_revision"], told


def test_a_second_client_watches_another_stretch_and_leaves_the_map_as_it_is(client, session, room):
    stream(session, room, 0, 25)
    session.wait_until_mapped()
    before = state_of(session)

    def backwards():
        for number, i in enumerate(reversed(range(8, 23))):
            frame = room.frame(i)
            yield frame_message(number, (number + 1) * 33_000_000, frame.rgb, frame.depth)

    with Client(client.url) as other:
        replies = list(other.session(session.name).watch(backwards()))

    assert replies[0].status is TrackingStatus.RELOCALISED
    assert {reply.status for reply in replies[1:]} == {TrackingStatus.TRACKED}
    assert max(errors_m([replace(reply, seq=22 - reply.seq) for reply in replies], room)) < 0.02
    assert state_of(session) == before


def test_a_watcher_follows_while_the_first_client_streams_and_its_death_changes_nothing(
    client, session, room
):
    undisturbed = stream(session, room, 0, 24)
    again = client.create_session(room.calibration, mode="offline", T_map_first=room.truth(0))
    stream(again, room, 0, 12)
    watched = []

    def watch():
        with Client(client.url) as other:
            replies = other.session(again.name).watch(frames_at(room, 2, 12))
            watched.extend(islice(replies, 6))  # and is gone in the middle of it

    watcher = threading.Thread(target=watch)
    watcher.start()
    replies = stream(again, room, 12, 24)
    watcher.join(60.0)

    told = {reply.seq: reply.T_map_camera.matrix() for reply in undisturbed}
    for reply in replies:
        np.testing.assert_array_equal(reply.T_map_camera.matrix(), told[reply.seq])
    assert len(watched) == 6
    assert max(errors_m(watched, room)) < 0.02
    assert [record.seq for record in again.trajectory()] == list(range(24))
    again.delete()


def frames_at(room, first, end):
    """Frames of one who watches, numbered as in the room."""
    for i in range(first, end):
        frame = room.frame(i)
        yield frame_message(i, frame.t_ns, frame.rgb, frame.depth)


def test_a_tracker_killed_in_the_middle_loses_no_frame_and_changes_no_pose(
    services, client, session, room
):
    undisturbed = [r.T_map_camera.matrix() for r in stream(session, room, 0, 12)]
    again = client.create_session(room.calibration, mode="offline", T_map_first=room.truth(0))
    replies = stream(again, room, 0, 4)
    for name in ("tracker-0", "tracker-1"):
        kill_and_restart(services, name)
        replies += stream(again, room, len(replies), len(replies) + 4)

    assert [reply.seq for reply in replies] == list(range(12))
    np.testing.assert_allclose(
        [reply.T_map_camera.matrix() for reply in replies], undisturbed, atol=1e-9
    )
    again.delete()


def test_a_frozen_tracker_is_left_for_another(services, session, room):
    replies = stream(session, room, 0, 2)
    for name in ("tracker-0", "tracker-1"):  # one of them is the session's
        frozen = process(services, name).pid
        os.kill(frozen, signal.SIGSTOP)
        try:
            replies += stream(session, room, len(replies), len(replies) + 3)
        finally:
            os.kill(frozen, signal.SIGCONT)
        wait_for(lambda: trackers(services) == 2)

    assert [reply.seq for reply in replies] == list(range(8))
    assert {reply.status for reply in replies} == {TrackingStatus.TRACKED}


def test_a_mapper_killed_in_the_middle_keeps_every_answered_frame(services, session, room):
    stream(session, room, 0, 15)
    keyframes = session.info()["keyframes"]
    kill_and_restart(services, "mapper-0")

    replies = stream(session, room, 15, 20)

    assert max(errors_m(replies, room)) < 0.01
    assert len(session.trajectory()) == 20
    assert session.info()["keyframes"] >= keyframes
    assert session.info()["epoch"] == 2


def test_an_image_is_found_in_a_map_taken_up_from_disk(services, session, room):
    stream(session, room, 0, 15)
    kill_and_restart(services, "mapper-0")
    image = room.frame(17)

    found = session.localize(image.rgb, image.depth)
    by_colour = session.localize(image.rgb)

    T_true = room.truth(17)
    assert found.status is LocalizationStatus.LOCALISED
    assert np.linalg.norm(found.T_map_camera.matrix()[:3, 3] - T_true[:3, 3]) < 0.01
    assert by_colour.status is LocalizationStatus.COLOUR_ONLY
    assert np.linalg.norm(by_colour.T_map_camera.matrix()[:3, 3] - T_true[:3, 3]) < 0.02
    assert len(session.trajectory()) == 15


def test_a_gateway_killed_in_the_middle_takes_the_session_up_again(services, client, session, room):
    stream(session, room, 0, 5)
    kill_and_restart(services, "gateway-0")
    wait_for(client.ready)

    resumed = client.session(session.name)
    replies = stream(resumed, room, 5, 10)

    assert [reply.seq for reply in replies] == [5, 6, 7, 8, 9]
    assert max(errors_m(replies, room)) < 0.01


def test_a_damaged_image_is_refused_by_field_and_the_session_goes_on(session, room):
    stream(session, room, 0, 2)
    good = room.frame(2)
    data = bytearray(good.depth.bytes)
    data[60 : len(data) - 60] = bytes(len(data) - 120)

    with pytest.raises(InputError) as caught:
        session.track(good.rgb, DepthImage(good.depth.encoding, bytes(data)), good.t_ns)

    assert caught.value.field == "depth.bytes"
    assert session.track(good.rgb, good.depth, good.t_ns).status is TrackingStatus.TRACKED


def test_the_benchmark_loses_no_reply(capsys):
    code = gateway_benchmark.main(["--json", "--seconds", "2", "--clients", "2"])

    assert code == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 60
