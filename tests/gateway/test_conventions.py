"""Poses for others: axes, the correction of odometry, events, and places on Earth."""

import json

import httpx
import numpy as np
import pytest

from pointslam.client import FrameOptions
from services.gateway.axes import Axes, in_axes
from shared.se3 import exp, inverse, quat_xyzw_from_rotation

SECOND = 1_000_000_000
PLACE = {"lat": 48.0, "lon": 11.0, "h": 500.0, "heading_deg": 90.0}


def url(gateway, session, rest):
    return f"{gateway.url}/v1/sessions/{session.name}{rest}"


@pytest.mark.parametrize(
    ("axes", "right_down_forward"),
    [("opencv", [1, 2, 3]), ("opengl", [1, -2, -3]), ("ros", [3, -1, -2])],
)
def test_a_step_is_the_same_step_in_every_convention(axes, right_down_forward):
    T = np.eye(4)
    T[:3, 3] = (1, 2, 3)

    np.testing.assert_allclose(in_axes(T, Axes(axes))[:3, 3], right_down_forward)


def test_a_turn_to_the_right_is_about_ros_down():
    T = exp([0, 0, 0, 0, 0.5, 0])  # about the camera's down

    x, y, z, _ = quat_xyzw_from_rotation(in_axes(T, Axes.ROS)[:3, :3])

    assert (x, y) == pytest.approx((0.0, 0.0)) and z < 0


@pytest.mark.parametrize("axes", list(Axes))
def test_conventions_keep_products_and_inverses(axes):
    A, B = exp([1, 2, 3, 0.1, 0.2, 0.3]), exp([0, 1, 0, 0.5, 0, 0.1])

    np.testing.assert_allclose(
        in_axes(A @ B, axes), in_axes(A, axes) @ in_axes(B, axes), atol=1e-12
    )
    np.testing.assert_allclose(in_axes(inverse(A), axes), inverse(in_axes(A, axes)), atol=1e-12)


def test_a_pose_comes_in_the_axes_that_are_asked_for(gateway, offline, rgb, depth):
    offline.track(rgb, depth, SECOND)
    offline.track(np.roll(rgb, 1, axis=1), depth, 2 * SECOND)

    told = {str(a): httpx.get(url(gateway, offline, f"/pose?frame={a}")).json() for a in Axes}

    assert told["opencv"]["T_map_camera"]["position"]["x"] == pytest.approx(0.01)
    assert told["ros"]["T_map_camera"]["position"]["y"] == pytest.approx(-0.01)
    assert {a: pose["frame"] for a, pose in told.items()} == {str(a): str(a) for a in Axes}
    assert httpx.get(url(gateway, offline, "/pose?frame=unity")).status_code == 422


def test_the_correction_of_odometry_takes_it_into_the_map(gateway, offline, rgb, depth):
    T_odom_camera = exp([0.5, 0, 0, 0, 0.3, 0])
    frame = offline.frame(rgb, depth, SECOND, FrameOptions(T_odom_camera=T_odom_camera))
    list(offline.stream([frame]))

    pose = httpx.get(url(gateway, offline, "/pose")).json()

    # The stand-in puts the first camera at the map's origin.
    q = quat_xyzw_from_rotation(inverse(T_odom_camera)[:3, :3])
    assert list(pose["T_map_odom"]["orientation"].values()) == pytest.approx(list(q), abs=1e-9)


def test_without_odometry_there_is_no_correction(gateway, offline, rgb, depth):
    offline.track(rgb, depth, SECOND)

    assert httpx.get(url(gateway, offline, "/pose")).json()["T_map_odom"] is None


def test_poses_come_as_events_while_frames_are_answered(gateway, offline, rgb, depth):
    with httpx.stream("GET", url(gateway, offline, "/pose/events?frame=ros")) as response:
        lines = response.iter_lines()
        assert next(lines).startswith(":")
        offline.track(rgb, depth, SECOND)
        event = next(line for line in lines if line.startswith("event:"))
        data = json.loads(next(lines).removeprefix("data: "))

    assert response.headers["content-type"].startswith("text/event-stream")
    assert (event, data["seq"], data["frame"]) == ("event: pose", 0, "ros")


def test_a_session_with_a_place_has_geoposes(gateway, offline, rgb, depth):
    offline.track(rgb, depth, SECOND)

    put = httpx.put(url(gateway, offline, "/georeference"), json=PLACE)
    told = httpx.get(url(gateway, offline, "/geopose")).json()

    assert (
        put.status_code == 200
        and httpx.get(url(gateway, offline, "/georeference")).json() == put.json()
    )
    assert told["position"] == pytest.approx({"lat": 48.0, "lon": 11.0, "h": 500.0}, abs=1e-6)
    assert set(told["quaternion"]) == {"x", "y", "z", "w"}
    assert told["accuracy"]["pos_std_m"] > 0


def test_a_ros_camera_that_looks_east_has_no_rotation_in_the_world(gateway, offline, rgb, depth):
    offline.track(rgb, depth, SECOND)
    httpx.put(url(gateway, offline, "/georeference"), json=PLACE)

    told = httpx.get(url(gateway, offline, "/geopose?frame=ros")).json()["quaternion"]

    assert abs(told["w"]) == pytest.approx(1.0)


def test_a_session_without_a_place_says_how_to_give_it_one(gateway, offline, rgb, depth):
    offline.track(rgb, depth, SECOND)

    response = httpx.get(url(gateway, offline, "/geopose"))

    assert response.status_code == 409
    assert "PUT /v1/sessions/" in response.json()["reason"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"lat": 91}, "lat"),
        ({"lon": "east"}, "lon"),
        ({"heading_deg": None}, "heading_deg"),
        ({"heading_deg": 1e9}, "heading_deg"),
        ({"altitude": 1}, "altitude"),
    ],
)
def test_a_place_that_is_none_is_refused_by_field(gateway, offline, change, field):
    response = httpx.put(url(gateway, offline, "/georeference"), json=PLACE | change)

    assert (response.status_code, response.json()["field"]) == (422, field)
