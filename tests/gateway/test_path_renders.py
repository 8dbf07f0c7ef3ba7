"""Views along a path as one file: where the camera goes, what is written, what is refused."""

import asyncio
import io
import json
import multiprocessing
import os
import zipfile

import cv2
import httpx
import numpy as np
import pytest

from pointslam.client import AsyncClient, Client
from services.gateway.path_renders.camera_path import orbit, smooth_path, timed_path, upward
from services.gateway.path_renders.temporary import ProcessFolder
from shared import se3
from shared.errors import ConflictError, InputError, NotFoundError
from shared.maps import JobState
from shared.path_renders import PathFormat, PathKind, PathRenderRequest
from shared.se3 import Pose, Vector3

KEYS = np.stack([se3.exp([0.3 * i, 0.1 * i * i, 0, 0, 0.4 * i, 0]) for i in range(5)])
POSES = tuple(Pose.from_matrix(T) for T in KEYS)


@pytest.fixture(scope="module")
def tracked(gateway, calibration, rgb, depth):
    with Client(gateway.url) as client:
        session = client.create_session(calibration, mode="offline")
        for i in range(12):
            session.track(rgb, depth, (i + 1) * 1_000_000_000)
        yield session
        session.delete()


def renders_url(gateway, session, rest=""):
    return f"{gateway.url}/v1/sessions/{session.name}/renders{rest}"


def pictures_in(video):
    reader, count = cv2.VideoCapture(str(video)), 0
    shape = None
    while (read := reader.read())[0]:
        shape, count = read[1].shape, count + 1
    return count, shape


def test_a_smooth_path_begins_and_ends_at_its_first_and_last_pose():
    path = smooth_path(KEYS, 50)

    np.testing.assert_allclose(path[[0, -1]], KEYS[[0, -1]], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(path[:, :3, :3]), 1.0, atol=1e-9)


def test_a_smooth_path_has_an_even_speed():
    steps_m = np.linalg.norm(np.diff(smooth_path(KEYS, 200)[:, :3, 3], axis=0), axis=1)

    assert steps_m.max() < 2.0 * steps_m.min()


def test_a_smooth_path_has_no_corner_where_it_passes_a_pose():
    positions = smooth_path(KEYS, 2000)[:, :3, 3]
    steps = np.diff(positions, axis=0)
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)

    assert (directions[1:] * directions[:-1]).sum(axis=1).min() > np.cos(np.radians(1.0))


def test_as_many_frames_as_poses_are_these_poses():
    np.testing.assert_array_equal(smooth_path(KEYS, len(KEYS)), KEYS)


def test_a_timed_path_is_where_the_camera_was_at_each_time():
    t_ns = np.array([0, 10, 40])

    path = timed_path(t_ns, KEYS[:3], 5)

    np.testing.assert_allclose(path[0], KEYS[0], atol=1e-12)
    np.testing.assert_allclose(path[1], KEYS[1], atol=1e-12)
    np.testing.assert_allclose(path[3], se3.interpolate(KEYS[1], KEYS[2], 2 / 3), atol=1e-9)


def test_an_orbit_keeps_its_distance_and_what_it_looks_at():
    T_first, centre, up = np.eye(4), np.array([0.0, 0.0, 2.0]), np.array([0.0, -1.0, 0.0])

    poses = [orbit(T_first, centre, up, turn) for turn in np.radians([0, 90, 180])]

    for T in poses:
        np.testing.assert_allclose(T[:3, 3] + 2.0 * T[:3, 2], centre, atol=1e-12)
    np.testing.assert_allclose(poses[2][:3, 3], [0, 0, 4], atol=1e-12)
    np.testing.assert_allclose(poses[1][1, 3], 0.0, atol=1e-12)


def test_cameras_held_upright_tell_which_way_is_up():
    np.testing.assert_allclose(upward(KEYS), [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize("format", [PathFormat.WEBM, PathFormat.MP4])
def test_a_video_has_every_picture(tracked, tmp_path, format):
    request = PathRenderRequest(frames=7, format=format)

    status = tracked.render_path(request, tmp_path / "film")

    assert (status.state, status.frames_done) == (JobState.DONE, 7)
    assert pictures_in(tmp_path / "film") == (7, (48, 64, 3))


def test_a_video_of_an_odd_size_loses_a_row_and_a_column(tracked, tmp_path):
    tracked.render_path(PathRenderRequest(frames=2, width=33), tmp_path / "film")

    assert pictures_in(tmp_path / "film") == (2, (24, 32, 3))


@pytest.mark.parametrize(
    ("format", "layer", "shape"),
    [
        (PathFormat.JPEG, "colour", (48, 64, 3)),
        (PathFormat.JPEG, "depth", (48, 64, 3)),
        (PathFormat.PNG, "confidence", (48, 64)),
    ],
)
def test_an_archive_has_numbered_pictures(tracked, tmp_path, format, layer, shape):
    request = PathRenderRequest(frames=3, format=format, layer=layer)

    tracked.render_path(request, tmp_path / "views.zip")

    with zipfile.ZipFile(tmp_path / "views.zip") as archive:
        pictures = sorted(name for name in archive.namelist() if name.endswith(format))
        first = cv2.imdecode(np.frombuffer(archive.read(pictures[0]), np.uint8), -1)
    assert pictures == [f"{i:06d}.{format}" for i in range(3)]
    assert first is not None
    assert first.shape == shape


def test_an_archive_of_depth_holds_millimetres_and_says_from_where(tracked, tmp_path):
    request = PathRenderRequest(
        path=PathKind.POSES, poses=POSES, frames=5, fps=10.0, format=PathFormat.PNG, layer="depth"
    )

    tracked.render_path(request, tmp_path / "views.zip")

    with zipfile.ZipFile(tmp_path / "views.zip") as archive:
        depth = cv2.imdecode(np.frombuffer(archive.read("000004.png"), np.uint8), -1)
        rows = [line.split() for line in archive.read("poses.txt").decode().splitlines()]
        camera = json.loads(archive.read("camera.json"))
    assert depth is not None
    assert np.unique(depth).tolist() == [1500]
    assert [float(row[0]) for row in rows] == [0.0, 0.1, 0.2, 0.3, 0.4]
    np.testing.assert_allclose(np.array(rows, float)[:, 1:4], KEYS[:, :3, 3], atol=1e-8)
    assert (camera["depth_scale"], camera["intrinsics"]["width"]) == (1000.0, 64)


@pytest.mark.parametrize("path", [PathKind.TRAJECTORY, PathKind.KEYFRAMES, PathKind.ORBIT])
def test_a_path_of_the_session_itself_needs_no_poses(tracked, tmp_path, path):
    request = PathRenderRequest(path=path, frames=4, format=PathFormat.JPEG, turn_deg=90.0)

    tracked.render_path(request, tmp_path / "views.zip")

    with zipfile.ZipFile(tmp_path / "views.zip") as archive:
        rows = np.loadtxt(io.BytesIO(archive.read("poses.txt")))
    assert rows.shape == (4, 8)
    assert not np.allclose(rows[0, 1:], rows[-1, 1:])


@pytest.mark.parametrize(
    ("request_", "field"),
    [
        (PathRenderRequest(frames=0), "frames"),
        (PathRenderRequest(frames=10**6), "frames"),
        (PathRenderRequest(fps=0.0), "fps"),
        (PathRenderRequest(layer="smell"), "layer"),
        (PathRenderRequest(path=PathKind.POSES), "poses"),
        (PathRenderRequest(width=-1), "intrinsics.width"),
        (PathRenderRequest(width=16000), "intrinsics.width"),
        (PathRenderRequest(path=PathKind.ORBIT, centre=Vector3(1e9, 0, 0)), "centre"),
        (PathRenderRequest(path=PathKind.ORBIT, turn_deg=1e6), "turn_deg"),
    ],
)
def test_what_cannot_be_drawn_is_refused_by_field(tracked, tmp_path, request_, field):
    with pytest.raises(InputError) as refused:
        tracked.render_path(request_, tmp_path / "film")

    assert refused.value.field == field
    assert list(tmp_path.iterdir()) == []


def test_a_session_without_a_pose_has_no_path(offline, tmp_path):
    with pytest.raises(NotFoundError, match="no pose yet"):
        offline.render_path(PathRenderRequest(), tmp_path / "film")


def test_one_path_of_a_session_is_drawn_at_a_time_until_it_is_cancelled(gateway, tracked, tmp_path):
    many = {"frames": 3600, "format": "png"}
    job = httpx.post(renders_url(gateway, tracked), json=many).json()["job"]

    with pytest.raises(ConflictError):
        tracked.render_path(PathRenderRequest(frames=1), tmp_path / "film")
    early = httpx.get(renders_url(gateway, tracked, f"/{job}/file"))
    ended = httpx.delete(renders_url(gateway, tracked, f"/{job}")).json()

    assert early.status_code == 409
    assert ended["state"] == "interrupted"
    assert ended["frames_done"] < 3600
    assert httpx.get(renders_url(gateway, tracked, f"/{job}")).status_code == 404
    tracked.render_path(PathRenderRequest(frames=1), tmp_path / "film")


def test_events_tell_how_far_it_is_and_the_file_may_be_fetched_twice(gateway, tracked):
    started = httpx.post(renders_url(gateway, tracked), json={"frames": 3})
    location = f"{gateway.url}{started.headers['location']}"

    with httpx.stream("GET", f"{location}/events", timeout=60.0) as response:
        lines = list(response.iter_lines())
    files = [httpx.get(f"{location}/file") for _ in range(2)]

    assert "event: end" in lines
    assert json.loads(lines[-2].removeprefix("data: "))["frames_done"] == 3
    assert files[0].headers["content-type"] == "video/webm"
    assert files[0].content == files[1].content
    assert len(files[0].content) == httpx.get(location).json()["bytes"]


def test_another_sessions_job_is_not_found(gateway, client, calibration, tracked):
    other = client.create_session(calibration, mode="offline")
    job = httpx.post(renders_url(gateway, tracked), json={"frames": 1}).json()["job"]

    answer = httpx.get(renders_url(gateway, other, f"/{job}"))
    other.delete()

    assert answer.status_code == 404


def test_the_asynchronous_client_gets_the_file_in_pieces(gateway, tracked, tmp_path):
    async def fetch():
        async with AsyncClient(gateway.url) as client:
            session = await client.session(tracked.name)
            return [piece async for piece in session.render_path(PathRenderRequest(frames=2))]

    (tmp_path / "film").write_bytes(b"".join(asyncio.run(fetch())))

    assert pictures_in(tmp_path / "film") == (2, (48, 64, 3))


def die_with_a_folder(parent):
    folder = ProcessFolder(parent)
    (folder.path / "half.webm").write_bytes(bytes(1000))
    os._exit(9)  # as a kill does: nothing is cleared


def test_what_a_process_left_that_died_is_cleared_by_the_next_and_nothing_else_is(tmp_path):
    living = ProcessFolder(tmp_path)
    process = multiprocessing.get_context("spawn").Process(
        target=die_with_a_folder, args=(tmp_path,)
    )
    process.start()
    process.join()
    left = set(tmp_path.iterdir()) - {living.path}

    following = ProcessFolder(tmp_path)

    assert len(left) == 1
    assert set(tmp_path.iterdir()) == {living.path, following.path}


def test_a_folder_that_is_closed_is_gone(tmp_path):
    ProcessFolder(tmp_path).close()

    assert not list(tmp_path.iterdir())
