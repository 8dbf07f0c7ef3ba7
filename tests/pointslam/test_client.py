"""The client library, synchronous and asynchronous, against a real gateway process."""

import asyncio

import httpx
import numpy as np
import pytest

from benchmarks.local_gateway import PATIENCE, local_gateway
from pointslam.client import AsyncClient, Client, FrameOptions, calls, frame_message
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import (
    ConflictError,
    InputError,
    NotFoundError,
    PointSlamError,
    StorageError,
    UnavailableError,
)
from shared.frames import ColourEncoding, DepthEncoding, TrackingStatus
from shared.images import decode_depth
from shared.localization import LocalizationStatus
from shared.se3 import exp
from shared.stream import ErrorDetail

SECOND = 1_000_000_000
CALIBRATION = Calibration(Camera(Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)), 1000.0)
RGB = np.zeros((48, 64, 3), np.uint8)
DEPTH = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)


@pytest.fixture(scope="module")
def gateway():
    with local_gateway(1, *PATIENCE) as running, Client(running.url) as client:
        while not client.ready():
            pass
        yield running


@pytest.fixture
def client(gateway):
    with Client(gateway.url) as client:
        yield client


@pytest.fixture
def session(client):
    return client.create_session(CALIBRATION, mode="offline")


def test_a_tracked_frame_gives_its_pose(session):
    reply = session.track(RGB, DEPTH, SECOND)

    assert reply.status is TrackingStatus.TRACKED
    np.testing.assert_array_equal(reply.T_map_camera.matrix(), session.pose())


def test_the_client_counts_the_frames(session):
    replies = [session.track(RGB, DEPTH, (i + 1) * SECOND) for i in range(3)]

    assert [reply.seq for reply in replies] == [0, 1, 2]


def test_a_refused_frame_does_not_count(session):
    with pytest.raises(InputError, match="rgb.bytes"):
        session.track(RGB[:10], DEPTH, SECOND)

    assert session.track(RGB, DEPTH, SECOND).seq == 0


def test_a_frame_kept_out_of_the_map_says_so():
    message = frame_message(0, 1, RGB, DEPTH, FrameOptions(may_be_keyframe=False))

    assert not message.frame().may_be_keyframe


def test_odometry_travels_as_a_pose():
    T_odom_camera = exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])

    message = frame_message(0, 1, RGB, DEPTH, FrameOptions(T_odom_camera=T_odom_camera))

    assert message.prior is not None
    np.testing.assert_allclose(message.prior.T_odom_camera.matrix(), T_odom_camera, atol=1e-12)


def test_arrays_travel_as_jpeg_and_exact_depth():
    message = frame_message(0, 1, RGB, DEPTH)

    depth_m = decode_depth(message.frame().depth, CALIBRATION)
    assert message.rgb.encoding is ColourEncoding.JPEG
    assert message.depth.encoding is DepthEncoding.PNG16
    np.testing.assert_allclose(depth_m, DEPTH / 1000.0, rtol=1e-6)


def test_online_and_final_poses_have_the_frames_stamps(session):
    for i in range(3):
        session.track(RGB, DEPTH, (i + 1) * SECOND)

    for kind in ("online", "final"):
        assert [t for t, _ in session.poses(kind)] == [SECOND, 2 * SECOND, 3 * SECOND]


def test_poses_of_an_unknown_kind_are_refused(session):
    with pytest.raises(InputError, match="kind"):
        session.poses("best")


def test_a_view_comes_with_colour_depth_and_opacity(session):
    view = session.render(np.eye(4))

    assert (view.rgb.shape, view.depth_m.dtype, int(view.alpha.max())) == (
        (48, 64, 3),
        np.float32,
        255,
    )


def test_an_exported_map_is_a_file(session, tmp_path):
    session.export("ply", tmp_path / "map.ply")

    assert (tmp_path / "map.ply").stat().st_size == 3000


def test_an_export_that_fails_says_why(client, session, tmp_path):
    session.delete()

    with pytest.raises(NotFoundError):
        session.export("ply", tmp_path / "map.ply")


def test_refining_tells_its_progress(session):
    seen = []

    session.refine(20, progress=lambda done, total: seen.append((done, total)))

    assert seen[-1] == (20, 20)


def test_a_session_is_mapped_when_nothing_is_pending(session):
    session.track(RGB, DEPTH, SECOND)

    session.wait_until_mapped()

    assert session.info()["pending"] == 0


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        ("invalid_input", InputError),
        ("too_large", InputError),
        ("not_found", NotFoundError),
        ("conflict", ConflictError),
        ("unavailable", UnavailableError),
        ("storage", StorageError),
        ("error", PointSlamError),
    ],
)
def test_errors_come_back_as_their_own_class(code, kind):
    assert type(calls.error_from(ErrorDetail(code, "f", "r"))) is kind


def test_an_answer_that_is_no_problem_document_is_told_as_it_is():
    response = httpx.Response(502, text="<html>bad gateway</html>")

    error = calls.error_from(calls.problem_of(response))

    assert isinstance(error, UnavailableError)
    assert "bad gateway" in str(error)


async def use_async(url):
    async with AsyncClient(url) as client:
        assert await client.ready()
        session = await client.create_session(CALIBRATION, mode="offline")
        first = await session.track(RGB, DEPTH, SECOND)

        async def frames():
            for i in range(10):
                yield session.frame(RGB, DEPTH, (i + 2) * SECOND)

        rest = [reply async for reply in session.stream(frames())]
        view = await session.render(np.eye(4))
        poses = await session.poses()
        await session.refine(10)
        await session.wait_until_mapped()
        size = sum([len(piece) async for piece in session.export("ply")])
        await session.delete()
        return [first, *rest], poses, view, size


def test_the_asynchronous_client_does_the_same(gateway):
    replies, poses, view, size = asyncio.run(use_async(gateway.url))

    assert [reply.seq for reply in replies] == list(range(11))
    assert [t for t, _ in poses] == [(i + 1) * SECOND for i in range(11)]
    assert view.rgb.shape == (48, 64, 3)
    assert size == 3000


async def localize_async(url, name):
    async with AsyncClient(url) as client:
        session = await client.session(name)
        return await session.localize(RGB, DEPTH, T_map_camera_prior=np.eye(4))


def test_both_clients_find_an_image_alike(gateway, session):
    a = session.localize(RGB, DEPTH, T_map_camera_prior=np.eye(4))

    b = asyncio.run(localize_async(gateway.url, session.name))

    assert a.status is LocalizationStatus.LOCALISED
    assert (a.status, a.T_map_camera, a.covariance) == (b.status, b.T_map_camera, b.covariance)


async def stream_to_nobody(url):
    async with AsyncClient(url) as client:
        session = await client.create_session(CALIBRATION)
        await session.delete()

        async def frames():
            yield session.frame(RGB, DEPTH, SECOND)

        return [reply async for reply in session.stream(frames())]


def test_an_asynchronous_stream_of_a_deleted_session_is_not_found(gateway):
    with pytest.raises(NotFoundError):
        asyncio.run(stream_to_nobody(gateway.url))
