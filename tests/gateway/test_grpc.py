"""The gRPC services against a real gateway process."""

from typing import Any

import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from shared.frames import ColourEncoding, ColourImage, DepthEncoding
from shared.images import decode_colour, encode_depth, encode_jpeg
from shared.wire import (
    map_service_pb2,
    map_service_pb2_grpc,
    pose_service_pb2,
    pose_service_pb2_grpc,
    session_service_pb2,
    session_service_pb2_grpc,
    tracking_service_pb2,
    tracking_service_pb2_grpc,
    types_pb2,
)

SECOND = 1_000_000_000
INTRINSICS = types_pb2.Intrinsics(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
CALIBRATION = types_pb2.Calibration(
    colour=types_pb2.Camera(intrinsics=INTRINSICS), depth_scale=1000.0
)


@pytest.fixture(scope="session")
def channel(gateway):
    with grpc.insecure_channel(gateway.grpc_address) as channel:
        yield channel


@pytest.fixture
def sessions(channel):
    return session_service_pb2_grpc.SessionServiceStub(channel)


@pytest.fixture
def poses(channel):
    return pose_service_pb2_grpc.PoseServiceStub(channel)


@pytest.fixture
def maps(channel):
    return map_service_pb2_grpc.MapServiceStub(channel)


@pytest.fixture
def name(sessions):
    request = session_service_pb2.CreateSessionRequest(
        calibration=CALIBRATION, mode=types_pb2.SESSION_MODE_OFFLINE
    )
    session_id = sessions.CreateSession(request).session.session_id
    yield session_id
    sessions.DeleteSession(session_service_pb2.DeleteSessionRequest(session_id=session_id))


@pytest.fixture(scope="session")
def images(rgb, depth):
    colour = tracking_service_pb2.ColourImage(
        encoding=tracking_service_pb2.COLOUR_ENCODING_JPEG, bytes=encode_jpeg(rgb).bytes
    )
    raw = tracking_service_pb2.DepthImage(
        encoding=tracking_service_pb2.DEPTH_ENCODING_RAW16,
        bytes=encode_depth(depth, DepthEncoding.RAW16).bytes,
    )
    return colour, raw


def requests(session_id, images, count):
    for seq in range(count):
        frame = tracking_service_pb2.Frame(
            seq=seq, t_ns=(seq + 1) * SECOND, rgb=images[0], depth=images[1]
        )
        yield tracking_service_pb2.TrackFramesRequest(session_id=session_id, frame=frame)


@pytest.fixture
def track(channel, name, images):
    stub = tracking_service_pb2_grpc.TrackingServiceStub(channel)

    def track(count):
        return list(stub.TrackFrames(requests(name, images, count), timeout=60))

    return track


def test_a_created_session_is_found_and_listed(sessions, name):
    found = sessions.GetSession(session_service_pb2.GetSessionRequest(session_id=name)).session
    listed = sessions.ListSessions(session_service_pb2.ListSessionsRequest()).sessions

    assert (found.mode, found.last_seq, found.credit) == (types_pb2.SESSION_MODE_OFFLINE, -1, 2)
    assert name in [session.session_id for session in listed]


def test_a_stream_of_frames_is_answered_in_order(track):
    replies = track(30)

    assert [reply.seq for reply in replies] == list(range(30))
    assert {reply.status for reply in replies} == {types_pb2.TRACKING_STATUS_TRACKED}
    assert replies[7].T_map_camera.position.x == pytest.approx(0.07)
    assert replies[0].keyframe and not replies[1].keyframe


def test_a_refused_frame_names_its_field_and_the_stream_goes_on(channel, name, images):
    stub = tracking_service_pb2_grpc.TrackingServiceStub(channel)
    good = list(requests(name, images, 2))
    bad = tracking_service_pb2.TrackFramesRequest(frame=good[1].frame)
    bad.frame.depth.bytes = b"short"
    empty = tracking_service_pb2.TrackFramesRequest(session_id=name)

    replies = list(stub.TrackFrames(iter([good[0], bad, empty, good[1]]), timeout=60))

    assert [reply.error.field for reply in replies] == ["", "depth.bytes", "frame", ""]
    assert [reply.seq for reply in replies] == [0, 1, -1, 1]
    assert replies[-1].status == types_pb2.TRACKING_STATUS_TRACKED


def test_the_newest_pose_and_the_pose_at_a_time(track, poses, name):
    track(5)

    newest = poses.GetPose(pose_service_pb2.GetPoseRequest(session_id=name)).pose
    request = pose_service_pb2.GetPoseAtRequest(session_id=name, t_ns=int(2.5 * SECOND))
    between = poses.GetPoseAt(request).pose

    assert (newest.seq, newest.is_interpolated) == (4, False)
    assert between.T_map_camera.position.x == pytest.approx(0.015)
    assert between.is_interpolated


def test_watchers_see_each_new_pose(track, poses, name):
    watch = poses.WatchPoses(pose_service_pb2.WatchPosesRequest(session_id=name), timeout=60)
    watch.initial_metadata()

    track(3)

    assert next(watch).pose.seq == 0
    watch.cancel()


def test_the_map_tells_its_state(track, maps, name):
    track(12)

    info = maps.GetMapInfo(map_service_pb2.GetMapInfoRequest(session_id=name))

    assert (info.frames, info.keyframes, info.mapper) == (12, 2, "mapper-0")
    assert info.loops == 1
    assert not info.HasField("psnr_db")


def test_a_view_is_an_image_of_the_asked_camera(track, maps, name, calibration):
    track(1)
    pose = types_pb2.Pose(orientation=types_pb2.Quaternion(w=1.0))

    view = maps.RenderView(map_service_pb2.RenderViewRequest(session_id=name, T_map_camera=pose))

    image = decode_colour(
        ColourImage(ColourEncoding.JPEG, view.image), calibration.colour.intrinsics
    )
    assert view.format == map_service_pb2.IMAGE_FORMAT_JPEG
    assert view.confidence == pytest.approx(128 / 255)
    assert np.abs(image.astype(int) - 128).max() <= 2


def test_the_exported_map_comes_in_pieces(track, maps, name):
    track(1)

    pieces = list(maps.ExportMap(map_service_pb2.ExportMapRequest(session_id=name)))

    assert [piece.offset for piece in pieces] == [0, 1000, 2000]
    assert sum(len(piece.bytes) for piece in pieces) == pieces[0].total


def refused(call):
    with pytest.raises(grpc.RpcError) as caught:
        call()
    error: Any = caught.value
    return error.code(), dict(error.trailing_metadata()).get("pointslam-field")


def test_an_unknown_session_is_not_found(poses):
    request = pose_service_pb2.GetPoseRequest(session_id="nobody")

    assert refused(lambda: poses.GetPose(request)) == (grpc.StatusCode.NOT_FOUND, "")


def test_negative_intrinsics_are_an_invalid_argument(sessions):
    calibration = types_pb2.Calibration()
    calibration.CopyFrom(CALIBRATION)
    calibration.colour.intrinsics.fx = -1.0
    request = session_service_pb2.CreateSessionRequest(calibration=calibration)

    status = refused(lambda: sessions.CreateSession(request))

    assert status == (grpc.StatusCode.INVALID_ARGUMENT, "calibration.colour.fx")


def test_a_view_without_a_pose_is_an_invalid_argument(maps, name):
    request = map_service_pb2.RenderViewRequest(session_id=name)

    status = refused(lambda: maps.RenderView(request))

    assert status == (grpc.StatusCode.INVALID_ARGUMENT, "T_map_camera")


def test_a_second_session_of_one_name_fails_its_precondition(sessions, name):
    request = session_service_pb2.CreateSessionRequest(calibration=CALIBRATION, session_id=name)

    code, _ = refused(lambda: sessions.CreateSession(request))

    assert code is grpc.StatusCode.FAILED_PRECONDITION


def test_a_message_over_the_limit_is_refused(channel, name):
    stub = tracking_service_pb2_grpc.TrackingServiceStub(channel)
    frame = tracking_service_pb2.Frame(seq=0, t_ns=1)
    frame.rgb.bytes = bytes((32 << 20) + 1)
    request = tracking_service_pb2.TrackFramesRequest(session_id=name, frame=frame)

    code, _ = refused(lambda: list(stub.TrackFrames(iter([request]), timeout=60)))

    assert code is grpc.StatusCode.RESOURCE_EXHAUSTED


def test_health_says_serving_for_each_service(channel):
    stub: Any = health_pb2_grpc.HealthStub(channel)

    for service in ("", "pointslam.v1.TrackingService", "pointslam.v1.MapService"):
        reply = stub.Check(health_pb2.HealthCheckRequest(service=service))

        assert reply.status == health_pb2.HealthCheckResponse.SERVING


def test_reflection_lists_the_services(channel):
    stub: Any = reflection_pb2_grpc.ServerReflectionStub(channel)
    request = reflection_pb2.ServerReflectionRequest(list_services="")

    (reply,) = stub.ServerReflectionInfo(iter([request]))

    names = {service.name for service in reply.list_services_response.service}
    assert {
        f"pointslam.v1.{area}Service" for area in ("Session", "Tracking", "Pose", "Map")
    } < names
