"""Where on Earth a camera is."""

import numpy as np
import pytest

from shared.errors import InputError
from shared.georeference import (
    GeoPosition,
    Georeference,
    T_enu_map_of_heading,
    geo_pose,
    quaternion_of,
)
from shared.se3 import from_quat_xyzw

MUNICH = GeoPosition(48.0, 11.0, 500.0)


def camera_at(x, y, z):
    T = np.eye(4)
    T[:3, 3] = (x, y, z)
    return T


def test_the_origin_of_the_map_is_where_it_was_said_to_be():
    pose = geo_pose(Georeference(MUNICH, T_enu_map_of_heading(0.0)), np.eye(4))

    assert (pose.position.lat, pose.position.lon) == pytest.approx((48.0, 11.0), abs=1e-12)
    assert pose.position.h == pytest.approx(500.0, abs=1e-6)


@pytest.mark.parametrize(
    ("heading_deg", "forward"), [(0, [0, 1, 0]), (90, [1, 0, 0]), (180, [0, -1, 0])]
)
def test_a_camera_looks_where_its_heading_says_with_down_down(heading_deg, forward):
    R = T_enu_map_of_heading(heading_deg)[:3, :3]

    np.testing.assert_allclose(R @ [0, 0, 1], forward, atol=1e-15)
    np.testing.assert_allclose(R @ [0, 1, 0], [0, 0, -1], atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_a_kilometre_to_the_north_is_a_kilometre_of_latitude():
    # Radius of curvature of the meridian at 48 degrees and 500 m: 6 371 417 m.
    pose = geo_pose(Georeference(MUNICH, T_enu_map_of_heading(0.0)), camera_at(0, 0, 1000))

    radius_m = 6_335_439.327 / (1 - 0.00669437999 * np.sin(np.radians(48)) ** 2) ** 1.5 + 500
    assert pose.position.lat - 48.0 == pytest.approx(np.degrees(1000 / radius_m), rel=1e-5)
    assert pose.position.lon == pytest.approx(11.0, abs=1e-9)


def test_a_metre_up_is_a_metre_of_height():
    pose = geo_pose(Georeference(MUNICH, T_enu_map_of_heading(30.0)), camera_at(0, -1.0, 0))

    assert pose.position.h == pytest.approx(501.0, abs=1e-6)


@pytest.mark.parametrize("lat", [-90.0, -45.0, 0.0, 89.9999, 90.0])
def test_positions_survive_the_way_over_the_earths_centre(lat):
    pose = geo_pose(Georeference(GeoPosition(lat, -179.5, -10.0), np.eye(4)), np.eye(4))

    assert pose.position.lat == pytest.approx(lat, abs=1e-9)
    assert pose.position.h == pytest.approx(-10.0, abs=1e-6)


def test_far_from_the_origin_up_is_up_there():
    pose = geo_pose(Georeference(MUNICH, np.eye(4)), camera_at(0, 10_000, 0))

    up = pose.R_enu_camera @ [0, 0, 1]
    assert up[1] < -1e-3  # seen from there the origin's up leans back to the south
    assert np.linalg.norm(up) == pytest.approx(1.0)


def test_the_quaternion_is_the_rotation():
    pose = geo_pose(Georeference(MUNICH, T_enu_map_of_heading(77.0)), np.eye(4))
    q = quaternion_of(pose)

    R = from_quat_xyzw((q.x, q.y, q.z, q.w), (0, 0, 0))[:3, :3]

    np.testing.assert_allclose(R, pose.R_enu_camera, atol=1e-12)


@pytest.mark.parametrize(
    ("position", "field"),
    [
        (GeoPosition(91.0, 0, 0), "lat"),
        (GeoPosition(0, float("nan"), 0), "lon"),
        (GeoPosition(0, 0, float("inf")), "h"),
    ],
)
def test_what_is_no_place_is_refused_by_field(position, field):
    with pytest.raises(InputError) as refused:
        position.check()

    assert refused.value.field == field
