"""Sessions, frames, poses and maps over HTTP, against a real gateway process."""

import json

import cv2
import httpx
import numpy as np
import pytest

from shared import codec, images
from shared.errors import ConflictError, InputError, NotFoundError
from shared.frames import ColourEncoding, ColourImage, TrackingStatus
from shared.se3 import exp, inverse
from shared.stream import FrameReply

STEP_M = 0.01  # the stand-in tracker's motion from frame to frame
SECOND = 1_000_000_000


def track(session, rgb, depth, count):
    """Frames that differ: the same image again would tell nothing of how the camera moves."""
    return [session.track(np.roll(rgb, i, axis=1), depth, (i + 1) * SECOND) for i in range(count)]


@pytest.fixture
def tracked(offline, rgb, depth):
    track(offline, rgb, depth, 12)
    return offline


def url(gateway, session, rest):
    return f"{gateway.url}/v1/sessions/{session.name}{rest}"


def test_a_created_session_is_listed_and_found(client, calibration):
    client.create_session(calibration, name="kitchen", mode="offline").delete()
    session = client.create_session(calibration, name="kitchen", mode="offline")

    names = [row["session"] for row in client.sessions()]

    assert "kitchen" in names
    assert client.session("kitchen").mode == "offline"
    session.delete()


def test_a_deleted_session_is_gone(client, calibration):
    session = client.create_session(calibration)

    session.delete()

    with pytest.raises(NotFoundError):
        client.session(session.name)


def test_a_second_session_of_one_name_is_a_conflict(client, calibration, offline):
    with pytest.raises(ConflictError, match="exists"):
        client.create_session(calibration, name=offline.name)


def test_the_first_frame_has_the_pose_that_the_client_gave(client, calibration, rgb, depth):
    T_map_first = exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    session = client.create_session(calibration, mode="offline", T_map_first=T_map_first)

    reply = session.track(rgb, depth, SECOND)

    assert reply.T_map_camera is not None
    np.testing.assert_allclose(reply.T_map_camera.matrix(), T_map_first, atol=1e-12)
    session.delete()


def test_a_frame_is_answered_with_pose_status_and_credit(offline, rgb, depth):
    reply = track(offline, rgb, depth, 3)[-1]

    assert (reply.seq, reply.status, reply.credit) == (2, TrackingStatus.TRACKED, 1)
    assert reply.T_map_camera is not None
    assert reply.T_map_camera.position.x == pytest.approx(2 * STEP_M)
    assert reply.pos_std_m == pytest.approx(np.sqrt(3e-6))


def test_a_reply_comes_as_json_where_that_is_accepted(gateway, offline, rgb, depth):
    message = offline.frame(rgb, depth, SECOND)

    response = httpx.post(
        url(gateway, offline, "/frames"),
        content=codec.pack(message),
        headers={"Accept": "application/json"},
    )

    assert codec.from_plain(FrameReply, response.json()).status is TrackingStatus.TRACKED


def test_each_answered_frame_reaches_the_map_before_the_next(gateway, tracked):
    entries = gateway.mapper.disk[tracked.name].entries

    assert [entry.record.seq for entry in entries] == list(range(12))
    assert [e.record.seq for e in entries if e.keyframe is not None] == [0, 10]


def test_only_keyframes_carry_their_images_to_the_map(gateway, tracked):
    entries = gateway.mapper.disk[tracked.name].entries

    assert all((entry.frame is not None) == (entry.keyframe is not None) for entry in entries)


def test_the_prior_tells_the_last_pose_and_its_motion(gateway, tracked, rgb, depth):
    tracked.track(rgb, depth, 100 * SECOND)

    (request,) = (
        tracker.requests[-1]
        for tracker in gateway.trackers
        if tracker.requests and tracker.requests[-1].session == tracked.name
    )

    prior = request.prior
    assert (prior.seq, prior.newest_keyframe_seq, prior.frames_since_keyframe) == (11, 10, 1)
    np.testing.assert_allclose(prior.T_before_last, exp([STEP_M, 0, 0, 0, 0, 0]), atol=1e-12)
    assert prior.before_last_dt_ns == SECOND


def test_a_lost_frame_is_answered_and_counted(offline, trackers, rgb, depth):
    track(offline, rgb, depth, 2)
    for tracker in trackers:
        tracker.status = TrackingStatus.LOST

    reply = offline.track(rgb, depth, 9 * SECOND)

    assert reply.status is TrackingStatus.LOST
    assert offline.info()["tracking"]["lost_frames"] == 1


def test_the_pose_between_two_frames_is_interpolated(tracked):
    T_map_camera = tracked.pose(5 * SECOND + SECOND // 2)

    assert T_map_camera[0, 3] == pytest.approx(4.5 * STEP_M)


def test_there_is_no_pose_outside_the_frames(tracked):
    with pytest.raises(NotFoundError, match="poses are kept from"):
        tracked.pose(SECOND // 2)


def test_a_session_without_frames_has_no_pose(offline):
    with pytest.raises(NotFoundError):
        offline.pose()


def test_the_trajectory_has_every_frame_with_its_stamp(tracked):
    poses = tracked.poses("online")

    assert [t_ns for t_ns, _ in poses] == [(i + 1) * SECOND for i in range(12)]
    np.testing.assert_allclose([T[0, 3] for _, T in poses], STEP_M * np.arange(12), atol=1e-12)


def test_a_tum_file_has_stamp_position_and_quaternion(gateway, tracked):
    text = httpx.get(url(gateway, tracked, "/trajectory.tum")).text

    assert text.splitlines()[1].split() == ["2.000000000", "0.010000000", *["0.000000000"] * 5] + [
        "1.000000000"
    ]


def test_a_rendered_view_is_a_jpeg_of_the_sessions_camera(gateway, tracked, calibration):
    response = httpx.get(url(gateway, tracked, "/render"))

    image = ColourImage(ColourEncoding.JPEG, response.content)
    assert response.headers["content-type"] == "image/jpeg"
    assert images.decode_colour(image, calibration.colour.intrinsics).shape == (48, 64, 3)


def test_a_pose_that_was_told_can_be_asked_back_as_a_view(gateway, tracked):
    told = httpx.get(url(gateway, tracked, "/pose")).json()["T_map_camera"]
    p, q = told["position"], told["orientation"]
    components = {f"p{k}": v for k, v in p.items()} | {f"q{k}": v for k, v in q.items()}

    whole = httpx.get(url(gateway, tracked, "/render"), params={"T_map_camera": json.dumps(told)})
    spelled = httpx.get(url(gateway, tracked, "/render"), params=components)

    assert whole.headers["etag"] == spelled.headers["etag"]


def test_a_view_of_an_unchanged_map_is_not_sent_again(gateway, tracked):
    first = httpx.get(url(gateway, tracked, "/render"))

    again = httpx.get(
        url(gateway, tracked, "/render"), headers={"If-None-Match": first.headers["etag"]}
    )

    assert (again.status_code, again.content) == (304, b"")


def test_a_changed_map_or_view_has_another_etag(gateway, tracked, rgb, depth):
    etag = httpx.get(url(gateway, tracked, "/render")).headers["etag"]
    other_view = httpx.get(url(gateway, tracked, "/render?px=1")).headers["etag"]
    for i in range(10):
        tracked.track(rgb, depth, (100 + i) * SECOND)

    other_map = httpx.get(url(gateway, tracked, "/render")).headers["etag"]

    assert len({etag, other_view, other_map}) == 3


def test_an_optimised_map_has_another_etag(gateway, tracked):
    etag = httpx.get(url(gateway, tracked, "/render")).headers["etag"]
    tracked.refine(50)

    again = httpx.get(url(gateway, tracked, "/render"), headers={"If-None-Match": etag})

    assert again.status_code == 200


def test_a_view_has_the_size_that_is_asked_for(tracked, calibration):
    view = tracked.render(inverse(np.eye(4)), calibration.colour.intrinsics.scaled(0.5))

    assert (view.rgb.shape, view.depth_m.shape, view.alpha.shape) == (
        (24, 32, 3),
        (24, 32),
        (24, 32),
    )


def test_depth_comes_as_millimetres_in_a_png(gateway, tracked):
    response = httpx.get(url(gateway, tracked, "/render?what=depth&format=png"))

    image = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert (image.dtype, int(image[0, 0])) == (np.uint16, 1500)


@pytest.mark.parametrize(("what", "value"), [("alpha", 255), ("confidence", 128)])
def test_alpha_and_confidence_come_as_a_grey_png(gateway, tracked, what, value):
    response = httpx.get(url(gateway, tracked, f"/render?what={what}&format=png"))

    image = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert (image.dtype, image.shape, int(image[0, 0])) == (np.uint8, (48, 64), value)


def test_every_view_tells_how_well_it_is_known(gateway, tracked):
    assert httpx.get(url(gateway, tracked, "/render")).headers["x-confidence"] == "0.502"


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("format=jpeg&what=depth", "format"),
        ("format=tiff", "format"),
        ("what=normals", "what"),
        ("fx=nan", "intrinsics.fx"),
        ("fx=-5", "intrinsics.fx"),
        ("width=60000", "intrinsics.width"),
        pytest.param(f"width=1{400 * '0'}", "intrinsics.width", id="width=1e400"),
        ("height=-48", "intrinsics.height"),
        (f"appearance_t_ns={1 << 70}", "appearance_t_ns"),
        ("qw=0", "orientation"),
        ("px=inf", "position"),
        ("width=many", "width"),
        ("T_map_camera={", "T_map_camera"),
        ('T_map_camera={"position": 1, "orientation": 1}', "position"),
    ],
)
def test_a_view_that_cannot_be_is_refused_by_field(gateway, tracked, query, field):
    response = httpx.get(url(gateway, tracked, f"/render?{query}"))

    assert (response.status_code, response.json()["field"]) == (422, field)
    assert response.headers["content-type"] == "application/problem+json"


def test_an_exported_map_arrives_whole(tracked, tmp_path):
    tracked.export("ply", tmp_path / "map.ply")

    assert (tmp_path / "map.ply").read_bytes() == b"".join(bytes([i]) * 1000 for i in range(3))


def test_refinement_and_saving_go_to_the_maps_owner(tracked):
    seen = []

    tracked.refine(50, lambda done, total: seen.append((done, total)))

    assert seen[-1] == (50, 50)
    assert tracked.save()["revision"] == 2


def test_a_refinement_is_a_job_with_a_place_and_events(gateway, tracked):
    path = url(gateway, tracked, "/refine")

    started = httpx.post(path, json={"iterations": 50})
    events = httpx.get(path + "/events")

    assert (started.status_code, started.json()["state"]) == (202, "running")
    assert path.endswith(started.headers["location"])
    assert events.headers["content-type"].startswith("text/event-stream")
    assert events.text.startswith("event: end\ndata: {")
    assert httpx.get(path).json()["iterations_done"] == 50
    assert httpx.delete(path).json()["state"] == "done"


def test_a_session_that_was_never_refined_has_no_events(gateway, tracked):
    path = url(gateway, tracked, "/refine")

    assert httpx.get(path + "/events").status_code == 404
    assert httpx.get(path).json()["state"] == "none"


def test_a_refinement_of_no_iterations_is_refused(tracked):
    with pytest.raises(InputError, match="iterations"):
        tracked.refine(0)


def test_the_gateway_is_ready_with_a_tracker_and_a_mapper(gateway):
    assert httpx.get(gateway.url + "/healthz").json() == {"status": "ok"}
    assert httpx.get(gateway.url + "/readyz").json() == {
        "status": "ready",
        "trackers": 2,
        "mappers": 1,
    }


def test_openapi_documents_the_binary_bodies_with_examples(gateway):
    paths = httpx.get(gateway.url + "/openapi.json").json()["paths"]

    frames = paths["/v1/sessions/{name}/frames"]["post"]["requestBody"]
    create = paths["/v1/sessions"]["post"]["requestBody"]["content"]["application/json"]
    assert "application/msgpack" in frames["content"]
    assert "registered depth" in create["examples"]


def test_every_example_of_openapi_creates_a_session(gateway):
    paths = httpx.get(gateway.url + "/openapi.json").json()["paths"]
    content = paths["/v1/sessions"]["post"]["requestBody"]["content"]["application/json"]

    for example in content["examples"].values():
        response = httpx.post(gateway.url + "/v1/sessions", json=example["value"])

        assert response.status_code == 201, response.text
        assert httpx.delete(gateway.url + response.headers["location"]).status_code == 204
