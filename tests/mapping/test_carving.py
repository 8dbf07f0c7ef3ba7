"""Carving: what hangs in space that a keyframe looks through."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from services.mapping.anchors.anchor_map import AnchorMap, NewAnchors
from services.mapping.anchors.carving import carve, seen_through
from services.mapping.config import AnchorConfig
from shared import se3
from shared.camera import Intrinsics
from shared.rectify import RgbdImage

CONFIG = AnchorConfig()
CAMERA = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)


@pytest.fixture
def wall() -> RgbdImage:
    """A wall 2 m in front of the camera."""
    depth_m = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    return RgbdImage(np.zeros((*depth_m.shape, 3), np.uint8), depth_m, CAMERA)


def on_axis(*depths_m: float) -> np.ndarray:
    return np.array([[0.0, 0.0, z] for z in depths_m], np.float32)


def anchors_at(positions: np.ndarray, is_primary: bool) -> AnchorMap:
    count = len(positions)
    anchors = AnchorMap(CONFIG, torch.device("cpu"))
    new = NewAnchors(
        positions=positions,
        features=np.zeros((count, 32), np.float32),
        offsets=np.zeros((count, 15), np.float32),
        scalings=np.zeros((count, 6), np.float32),
        keys=np.arange(count),
        is_primary=np.full(count, is_primary),
    )
    anchors.append(new, creator_seq=0)
    return anchors


def test_only_what_is_well_in_front_of_the_measured_surface_is_seen_through(wall):
    positions = on_axis(1.0, 1.5, 1.95, 2.0, 2.5, -1.0)

    through = seen_through(positions, wall, np.eye(4), CONFIG)

    assert through.tolist() == [True, True, False, False, False, False]


def test_what_lies_outside_the_image_is_not_judged(wall):
    T_world_camera = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0]))

    assert not seen_through(on_axis(1.0), wall, T_world_camera, CONFIG).any()


def test_a_corner_without_readings_says_nothing(wall):
    wall.depth_m[:8, :8] = 0.0
    corner = np.array([[-31.5 / 50.0, -23.5 / 50.0, 1.0]], np.float32)

    assert not seen_through(corner, wall, np.eye(4), CONFIG).any()


def test_a_hole_in_the_depth_says_nothing(wall):
    wall.depth_m[:] = 0.0

    assert not seen_through(on_axis(1.0), wall, np.eye(4), CONFIG).any()


def test_one_empty_pixel_among_readings_does_not_hide_an_anchor_from_judgement(wall):
    wall.depth_m[23:25, 31:33] = 0.0

    assert seen_through(on_axis(1.0), wall, np.eye(4), CONFIG).all()


def test_an_anchor_beside_the_edge_of_a_near_surface_stays(wall):
    wall.depth_m[:, 34:] = 1.0

    assert not seen_through(on_axis(1.0), wall, np.eye(4), CONFIG).any()


def test_carving_removes_secondary_anchors(wall):
    anchors = anchors_at(on_axis(1.0, 2.0), is_primary=False)

    count = carve(anchors, wall, np.eye(4), CONFIG)

    assert count == 1
    assert anchors.rows["position"][:, 2].tolist() == [2.0]


def test_carving_leaves_primary_anchors(wall):
    anchors = anchors_at(on_axis(1.0, 2.0), is_primary=True)

    assert carve(anchors, wall, np.eye(4), CONFIG) == 0
