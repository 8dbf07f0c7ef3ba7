"""Keyframes that see the same place."""

from __future__ import annotations

import numpy as np
import pytest

from services.mapping.views.overlap import overlapping, points_of, share_inside
from shared import se3
from shared.camera import Intrinsics
from shared.rectify import RgbdImage

CAMERA = Intrinsics(fx=64.0, fy=64.0, cx=63.5, cy=47.5, width=128, height=96)
WALL = RgbdImage(np.zeros((96, 128, 3), np.uint8), np.full((96, 128), 2.0, np.float32), CAMERA)


def test_points_lie_on_the_measured_surface():
    points = points_of(WALL, se3.exp([0, 0, 1.0, 0, 0, 0]))

    assert points.shape == (48, 3)
    np.testing.assert_allclose(points[:, 2], 3.0)


@pytest.mark.parametrize(("shift_m", "expected"), [(0.0, 1.0), (2.0, 0.5), (5.0, 0.0)])
def test_the_share_falls_with_the_shift_along_the_wall(shift_m, expected):
    points = points_of(WALL, np.eye(4))

    share = share_inside(points, se3.exp([shift_m, 0, 0, 0, 0, 0]), CAMERA)

    assert share == pytest.approx(expected)


def test_a_camera_that_looks_away_sees_nothing():
    turned = se3.exp([0, 0, 0, 0, np.pi, 0])

    assert share_inside(points_of(WALL, np.eye(4)), turned, CAMERA) == 0.0


def test_an_image_without_depth_overlaps_nothing():
    blind = RgbdImage(WALL.rgb, np.zeros_like(WALL.depth_m), CAMERA)

    assert overlapping(blind, np.eye(4), [(0, np.eye(4))], 0.3) == []


def test_only_views_with_enough_in_common_are_named():
    others = [(seq, se3.exp([shift, 0, 0, 0, 0, 0])) for seq, shift in ((3, 0.5), (7, 3.5))]

    assert overlapping(WALL, np.eye(4), others, 0.3) == [3]
