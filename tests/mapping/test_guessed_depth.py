"""Guesses for depth that a sensor left out, and what other keyframes say of them."""

from __future__ import annotations

import numpy as np
import pytest

from services.mapping.config import AnchorConfig
from services.mapping.views.guessed_depth import with_guesses
from services.mapping.views.sightings import MAX_FACING, Sightings
from services.mapping.views.training_views import TrainingView
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import DepthEncoding, Frame
from shared.images import encode_depth, encode_jpeg
from shared.rectify import RgbdImage, rectify

CAMERA = Intrinsics(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
CALIBRATION = Calibration(Camera(CAMERA), depth_scale=1000.0)
HOLE = slice(40, 80), slice(60, 100)


def seeing(*depths_m: float) -> tuple[Sightings, list[TrainingView]]:
    """Keyframes at the origin that each measured a wall at one depth."""
    sightings, keyframes = Sightings(CALIBRATION), []
    for seq, z in enumerate(depths_m):
        depth = np.full((CAMERA.height, CAMERA.width), round(1000 * z), np.uint16)
        colour = encode_jpeg(np.zeros((*depth.shape, 3), np.uint8))
        frame = Frame(seq, seq, colour, encode_depth(depth, DepthEncoding.RAW16))
        sightings.add(seq, rectify(frame, CALIBRATION))
        keyframes.append(TrainingView(seq, seq, frame, np.eye(4)))
    return sightings, keyframes


@pytest.fixture
def image() -> RgbdImage:
    """A wall 2 m in front, with a hole in its depth."""
    depth_m = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    depth_m[HOLE] = 0.0
    return RgbdImage(np.zeros((*depth_m.shape, 3), np.uint8), depth_m, CAMERA)


def test_a_hole_gets_the_depth_around_it_where_no_keyframe_looks_through(image):
    filled = with_guesses(image, np.eye(4), *seeing(2.0), AnchorConfig())

    assert np.allclose(filled.depth_m, 2.0)


def test_a_guess_that_a_keyframe_looks_through_goes_behind_and_readings_stay(image):
    filled = with_guesses(image, np.eye(4), *seeing(2.9), AnchorConfig())

    assert np.allclose(filled.depth_m[HOLE], 3.0)
    assert np.array_equal(filled.depth_m[image.depth_m > 0], image.depth_m[image.depth_m > 0])


def test_single_pixels_that_a_sensor_leaves_out_do_not_hide_what_it_looks_through(image):
    depth = np.full((CAMERA.height, CAMERA.width), 2900, np.uint16)
    depth[::2, ::2] = 0
    frame = Frame(
        0,
        0,
        encode_jpeg(np.zeros((*depth.shape, 3), np.uint8)),
        encode_depth(depth, DepthEncoding.RAW16),
    )
    sightings = Sightings(CALIBRATION)
    sightings.add(0, rectify(frame, CALIBRATION))

    filled = with_guesses(
        image, np.eye(4), sightings, [TrainingView(0, 0, frame, np.eye(4))], AnchorConfig()
    )

    assert np.allclose(filled.depth_m[HOLE], 3.0)


def test_nothing_is_guessed_where_keyframes_look_through_every_guess(image):
    filled = with_guesses(image, np.eye(4), *seeing(9.0), AnchorConfig())

    assert not filled.depth_m[HOLE].any()


def test_without_filling_the_image_is_as_it_was(image):
    assert with_guesses(image, np.eye(4), *seeing(2.0), AnchorConfig(fill_holes=False)) is image


def test_of_many_keyframes_those_that_face_the_points_are_asked(image):
    sightings, keyframes = seeing(*[2.0] * (MAX_FACING + 3))
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    turned = [
        TrainingView(k.seq, k.t_ns, k.frame, behind if k.seq < 3 else np.eye(4)) for k in keyframes
    ]

    chosen = sightings.facing(np.array([[0.0, 0.0, 2.0]]), turned)

    assert [k.seq for k in chosen] == list(range(3, MAX_FACING + 3))
