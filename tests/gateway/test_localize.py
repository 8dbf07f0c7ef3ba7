"""Single images found in a session's map, over HTTP and gRPC, against a real gateway process."""

import dataclasses
import threading

import grpc
import httpx
import numpy as np
import pytest

from benchmarks.cluster import wait_for
from pointslam.client.messages import localize_message
from services.gateway.localizer import read_localize
from shared import codec
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import InputError, NotFoundError
from shared.frames import DepthEncoding
from shared.images import encode_depth, encode_jpeg
from shared.localization import LocalizationStatus, LocalizeMessage, LocalizeReply
from shared.se3 import Pose, exp
from shared.wire import tracking_service_pb2, tracking_service_pb2_grpc, types_pb2

THERE = exp([0.5, -0.2, 1.0, 0.1, 0.2, 0.3])
OTHER = Camera(Intrinsics(30.0, 30.0, 15.5, 11.5, 32, 24))


def asked(gateway, session):
    (request,) = (t.images[-1] for t in gateway.trackers if t.images[-1:])
    assert request.session == session.name
    return request


@pytest.fixture(autouse=True)
def forget_images(gateway):
    yield
    for tracker in gateway.trackers:
        tracker.images.clear()


def test_a_found_image_is_answered_with_pose_accuracy_and_revision(offline, rgb, depth):
    offline.track(rgb, depth, 1)

    reply = offline.localize(rgb, depth, T_map_camera_prior=THERE)

    assert (reply.status, reply.reason) == (LocalizationStatus.LOCALISED, "")
    np.testing.assert_allclose(reply.T_map_camera.matrix(), THERE, atol=1e-9)
    assert reply.pos_std_m == pytest.approx(np.sqrt(3e-6))
    np.testing.assert_allclose(np.reshape(reply.covariance, (6, 6)), 1e-6 * np.eye(6))
    assert reply.map_revision == 1


def test_an_image_that_is_not_found_has_a_reason_and_no_pose(offline, rgb, depth):
    reply = offline.localize(rgb, depth)

    assert reply.status is LocalizationStatus.NOT_LOCALISED
    assert reply.reason == "no keyframe looks like this"
    assert (reply.T_map_camera, reply.pos_std_m, reply.covariance) == (None, None, ())


def test_localizing_leaves_the_trajectory_alone(offline, rgb, depth):
    offline.track(rgb, depth, 1)

    offline.localize(rgb, depth, T_map_camera_prior=THERE)

    assert len(offline.trajectory()) == 1
    assert offline.track(rgb, depth, 2).seq == 1


def test_colour_alone_may_come_from_another_camera(gateway, offline):
    small = np.zeros((24, 32, 3), np.uint8)

    reply = offline.localize(small, device=OTHER, T_map_camera_prior=THERE)

    assert reply.status is LocalizationStatus.COLOUR_ONLY
    assert asked(gateway, offline).calibration.colour == OTHER
    assert asked(gateway, offline).depth is None


def test_depth_may_come_from_another_device(gateway, offline):
    other = Calibration(OTHER, 5000.0)

    offline.localize(np.zeros((24, 32, 3), np.uint8), np.ones((24, 32), np.uint16), device=other)

    assert asked(gateway, offline).calibration.depth_scale == 5000.0


def test_the_reply_comes_as_json_where_that_is_accepted(gateway, offline, rgb, depth):
    message = localize_message(rgb, depth, None, THERE)

    response = httpx.post(
        f"{gateway.url}/v1/sessions/{offline.name}/localize",
        content=codec.pack(message),
        headers={"Accept": "application/json"},
    )

    reply = codec.from_plain(LocalizeReply, response.json())
    assert reply.status is LocalizationStatus.LOCALISED


def test_there_is_no_session_to_localize_in(gateway, rgb):
    response = httpx.post(
        f"{gateway.url}/v1/sessions/nowhere/localize",
        content=codec.pack(localize_message(rgb, None, None, None)),
    )

    assert (response.status_code, response.json()["code"]) == (404, NotFoundError.code)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"camera": OTHER}, "rgb.bytes"),
        ({"camera": OTHER, "calibration": Calibration(OTHER, 1000.0)}, "camera"),
        ({"calibration": Calibration(OTHER, -1.0)}, "calibration.depth_scale"),
        ({"T_map_camera_prior": Pose.from_matrix(exp([2e4, 0, 0, 0, 0, 0]))}, "T_map_camera_prior"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_field(calibration, rgb, change, field):
    message = dataclasses.replace(localize_message(rgb, None, None, None), **change)

    with pytest.raises(InputError, match=field):
        read_localize(codec.pack(message), calibration)


def test_a_camera_of_colour_alone_is_refused_with_depth(calibration):
    images = np.zeros((24, 32, 3), np.uint8), np.ones((24, 32), np.uint16)
    message = localize_message(*images, OTHER, None)

    with pytest.raises(InputError, match="with depth, give the calibration"):
        read_localize(codec.pack(message), calibration)


@pytest.mark.parametrize("data", [b"", b"\x93\x01\x02\x03", b"\x81\xa6camera\x01", b"\xdf" * 9])
def test_bytes_that_are_no_question_are_refused(calibration, data):
    with pytest.raises(InputError):
        read_localize(data, calibration)


def test_a_message_longer_than_its_images_is_refused_before_it_is_read(calibration, rgb):
    message = localize_message(rgb, None, None, None)
    longer = dataclasses.replace(message.rgb, bytes=bytes(1 << 20))

    with pytest.raises(InputError, match="at most"):
        read_localize(codec.pack(LocalizeMessage(longer)), calibration)


def test_too_many_images_at_a_time_are_told_to_come_again(gateway, client, offline, rgb, trackers):
    for tracker in trackers:
        tracker.may_answer.clear()
    url = f"{gateway.url}/v1/sessions/{offline.name}/localize"
    body = codec.pack(localize_message(rgb, None, None, None))
    codes: list[int] = []
    threads = [
        threading.Thread(
            target=lambda: codes.append(httpx.post(url, content=body, timeout=60).status_code)
        )
        for _ in range(9)
    ]

    for thread in threads:
        thread.start()
    wait_for(lambda: len(codes) == 1)
    for tracker in trackers:
        tracker.may_answer.set()
    for thread in threads:
        thread.join()

    assert codes == [503] + [200] * 8


@pytest.fixture(scope="module")
def tracking(gateway):
    with grpc.insecure_channel(gateway.grpc_address) as channel:
        yield tracking_service_pb2_grpc.TrackingServiceStub(channel)


def question(session, rgb, **more):
    colour = tracking_service_pb2.ColourImage(
        encoding=tracking_service_pb2.COLOUR_ENCODING_JPEG, bytes=encode_jpeg(rgb).bytes
    )
    return tracking_service_pb2.LocalizeRequest(session_id=session.name, rgb=colour, **more)


def test_grpc_finds_an_image(tracking, offline, rgb, depth):
    raw = tracking_service_pb2.DepthImage(
        encoding=tracking_service_pb2.DEPTH_ENCODING_RAW16,
        bytes=encode_depth(depth, DepthEncoding.RAW16).bytes,
    )
    there = types_pb2.Pose(
        position=types_pb2.Vector3(x=1.0), orientation=types_pb2.Quaternion(w=1.0)
    )

    reply = tracking.Localize(question(offline, rgb, depth=raw, T_map_camera_prior=there))

    assert reply.status == tracking_service_pb2.LOCALIZATION_STATUS_LOCALISED
    assert reply.T_map_camera.position.x == pytest.approx(1.0)
    assert len(reply.covariance) == 36


def test_grpc_tells_why_an_image_is_not_found(tracking, offline, rgb):
    reply = tracking.Localize(question(offline, rgb))

    assert reply.status == tracking_service_pb2.LOCALIZATION_STATUS_NOT_LOCALISED
    assert reply.reason == "no keyframe looks like this"
    assert not reply.HasField("T_map_camera")


def test_grpc_refuses_an_image_of_another_size_by_its_field(tracking, offline):
    with pytest.raises(grpc.RpcError) as refused:
        tracking.Localize(question(offline, np.zeros((24, 32, 3), np.uint8)))

    assert refused.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert "rgb.bytes" in (refused.value.details() or "")
