"""What those who watch a session get: its image, path, keyframes, events, and views as a stream."""

import dataclasses
import json
from itertools import islice

import cv2
import httpx
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from services.gateway.events import SessionEvents
from services.gateway.owner import largest_shift_m
from shared import codec, se3
from shared.frames import TrackingStatus
from shared.se3 import Pose
from shared.tracks import KeyframePoses

SECOND = 1_000_000_000
CAMERA = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
HERE = codec.to_json(Pose.from_matrix(np.eye(4)))


def track(session, rgb, depth, count):
    for i in range(count):
        session.track(rgb, depth, (i + 1) * SECOND)


def url_of(gateway, session, what):
    return f"{gateway.url}/v1/sessions/{session.name}/{what}"


def shape_of(jpeg):
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image.shape


def events_of(gateway, session, count, headers=None):
    """The first `count` server-sent events, as (kind, what)."""
    found = []
    url = url_of(gateway, session, "events")
    with httpx.stream("GET", url, headers=headers, timeout=60.0) as response:
        kind = ""
        for line in response.iter_lines():
            if line.startswith("event: "):
                kind = line[7:]
            elif line.startswith("data: "):
                found.append((kind, json.loads(line[6:])))
                if len(found) == count:
                    return found
    return found


def test_the_newest_image_is_a_jpeg_until_a_newer_frame_comes(gateway, offline, rgb, depth):
    track(offline, rgb, depth, 2)

    first = httpx.get(url_of(gateway, offline, "image"))
    same = httpx.get(
        url_of(gateway, offline, "image"), headers={"If-None-Match": first.headers["etag"]}
    )
    offline.track(rgb, depth, 3 * SECOND)
    newer = httpx.get(url_of(gateway, offline, "image"))

    assert shape_of(first.content) == rgb.shape
    assert (first.headers["etag"], newer.headers["etag"]) == ('"1"', '"2"')
    assert same.status_code == 304


def test_a_session_without_a_frame_has_no_image(gateway, offline):
    assert httpx.get(url_of(gateway, offline, "image")).status_code == 204


def test_keyframes_have_their_poses_and_images(gateway, offline, rgb, depth):
    track(offline, rgb, depth, 12)

    rows = httpx.get(url_of(gateway, offline, "keyframes")).json()["keyframes"]
    image = httpx.get(url_of(gateway, offline, "keyframes/10/image"))
    missing = httpx.get(url_of(gateway, offline, "keyframes/11/image"))

    assert {row["seq"] for row in rows} <= {0, 10}
    assert image.headers["x-time-ns"] == str(11 * SECOND)
    assert shape_of(image.content) == rgb.shape
    assert missing.status_code == 404


def test_a_path_is_thinned_out_and_ends_where_the_camera_was_lost(
    gateway, offline, trackers, rgb, depth
):
    track(offline, rgb, depth, 20)
    for tracker in trackers:
        tracker.status = TrackingStatus.LOST
    offline.track(rgb, depth, 21 * SECOND)
    for tracker in trackers:
        tracker.status = TrackingStatus.TRACKED
    offline.track(rgb, depth, 22 * SECOND)

    whole = httpx.get(url_of(gateway, offline, "path")).json()
    thin = httpx.get(url_of(gateway, offline, "path?max_points=5")).json()

    assert [len(run) for run in whole["runs"]] == [20, 1]
    assert whole["runs"][0][7] == [0.07, 0.0, 0.0]
    assert sum(len(run) for run in thin["runs"]) <= 5


def test_the_list_tells_how_sessions_go(gateway, offline, rgb, depth):
    track(offline, rgb, depth, 3)

    rows = httpx.get(f"{gateway.url}/v1/sessions").json()["sessions"]

    tracking = next(row for row in rows if row["session"] == offline.name)["tracking"]
    assert tracking["status"] == "TRACKED"
    assert tracking["inlier_share"] == 0.5
    assert tracking["frame_rate_hz"] > 0


def test_events_begin_with_the_pose_and_the_map(gateway, offline, rgb, depth):
    track(offline, rgb, depth, 1)

    (first, pose), (second, of_map) = events_of(gateway, offline, 2)

    assert (first, pose["seq"], pose["tracking"]["status"]) == ("pose", 0, "TRACKED")
    assert (second, set(of_map)) == ("map", {"map_revision", "keyframes", "loops"})


def ids_of(gateway, session, count):
    """The ids of the first events that have one."""
    with httpx.stream("GET", url_of(gateway, session, "events")) as answer:
        numbered = (line for line in answer.iter_lines() if line.startswith("id: "))
        return [line.removeprefix("id: ") for line in islice(numbered, count)]


def test_events_tell_that_the_camera_was_lost_found_and_the_map_saved(
    gateway, offline, trackers, rgb, depth
):
    track(offline, rgb, depth, 1)
    for tracker in trackers:
        tracker.status = TrackingStatus.LOST
    offline.track(rgb, depth, 2 * SECOND)
    offline.track(rgb, depth, 3 * SECOND)
    for tracker in trackers:
        tracker.status = TrackingStatus.RELOCALISED
    offline.track(rgb, depth, 4 * SECOND)
    httpx.post(url_of(gateway, offline, "save"))

    told = dict(events_of(gateway, offline, 5))
    second = ids_of(gateway, offline, 2)[-1]
    later = events_of(gateway, offline, 3, {"Last-Event-ID": second})

    assert told["lost"]["seq"] == 1
    assert (told["relocalized"]["seq"], told["relocalized"]["lost_frames"]) == (3, 2)
    assert told["saved"]["bytes"] == 1000
    assert [kind for kind, _ in later] == ["pose", "map", "saved"]


def test_a_camera_that_is_never_found_is_lost_once():
    events = SessionEvents()

    for seq in range(5):
        events.hear(seq, TrackingStatus.LOST)

    assert len(events.after(0)) == 1


def test_a_loop_shift_is_that_of_the_keyframe_that_moved_most():
    old = KeyframePoses(1, np.array([0, 5]), np.stack([np.eye(4)] * 2))
    moved = se3.exp([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
    new = KeyframePoses(2, np.array([0, 5, 9]), np.stack([np.eye(4), moved, np.eye(4)]))

    assert largest_shift_m(old, new) == pytest.approx(0.3)


def camera(**changes):
    return json.dumps({"id": 1, "T_map_camera": HERE, "intrinsics": CAMERA} | changes)


@pytest.fixture
def view(gateway, offline, rgb, depth):
    track(offline, rgb, depth, 1)
    with connect(url_of(gateway, offline, "view").replace("http", "ws")) as socket:
        yield socket


@pytest.mark.parametrize("layer", ["colour", "depth", "confidence"])
def test_a_camera_is_answered_with_its_layer_as_a_jpeg(view, layer):
    view.send(camera(id=7, layer=layer))

    about, jpeg = json.loads(view.recv(60)), view.recv(60)

    assert about["id"] == 7
    assert about["range_m"] == ([1.5, 1.5] if layer == "depth" else None)
    assert shape_of(jpeg) == (48, 64, 3)


def test_of_many_cameras_the_last_one_is_answered(view):
    for i in range(200):
        view.send(camera(id=i))

    ids = []
    while not ids or ids[-1] < 199:
        ids.append(json.loads(view.recv(60))["id"])
        view.recv(60)

    assert len(ids) < 200
    assert ids == sorted(ids)


def test_a_view_comes_again_when_the_map_has_changed(gateway, offline, view, rgb, depth):
    view.send(camera())
    before = json.loads(view.recv(60))
    view.recv(60)
    for i in range(1, 12):
        offline.track(rgb, depth, (i + 1) * SECOND)

    after = json.loads(view.recv(60))

    assert after["map_revision"] > before["map_revision"]


@pytest.mark.parametrize(
    ("message", "field"),
    [
        ("no JSON", "message"),
        (camera(layer="smell"), "layer"),
        (camera(intrinsics=CAMERA | {"width": 8}), "intrinsics.width"),
        (camera(intrinsics=CAMERA | {"width": 8000, "height": 8000}), "intrinsics.width"),
        (camera(T_map_camera=None), "T_map_camera"),
        (camera() + " " * 5000, "message"),
    ],
)
def test_a_camera_that_makes_no_sense_is_refused_and_the_next_is_drawn(view, message, field):
    view.send(message)
    refusal = json.loads(view.recv(60))
    view.send(camera(id=2))

    assert refusal["error"]["field"].startswith(field)
    assert json.loads(view.recv(60))["id"] == 2


def test_views_of_no_session_are_refused_with_a_problem(gateway):
    with pytest.raises(InvalidStatus) as caught:
        connect(f"{gateway.url}/v1/sessions/nowhere/view".replace("http", "ws"))

    assert caught.value.response.status_code == 404


def test_a_live_session_is_saved_while_frames_keep_coming(gateway, live, trackers, rgb, depth):
    for tracker in trackers:
        tracker.delay_s = 0.05
    queue = [live.frame(rgb, depth, (i + 1) * SECOND) for i in range(60)]

    def paced():
        for i, frame in enumerate(queue):
            if i == 20:
                saved.append(httpx.post(url_of(gateway, live, "save"), timeout=60.0).status_code)
            yield dataclasses.replace(frame)

    saved: list[int] = []
    list(live.stream(paced()))

    assert saved == [200]
