"""Guesses for depth that a sensor left out, and what other keyframes say of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from services.mapping.anchors.seeding import SeedRequest
from services.mapping.config import AnchorConfig
from services.mapping.views import guessed_depth
from services.mapping.views.sightings import MAX_FACING, Sightings
from services.mapping.views.training_views import TrainingView
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import DepthEncoding, Frame
from shared.images import encode_depth, encode_jpeg
from shared.rectify import RgbdImage, rectify

CAMERA = Intrinsics(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
CALIBRATION = Calibration(Camera(CAMERA), depth_scale=1000.0)
NO_LANDMARKS = np.zeros((0, 3))
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


def with_guesses(
    image: RgbdImage,
    T_world_camera: np.ndarray,
    sightings: Sightings,
    keyframes: list[TrainingView],
    config: AnchorConfig,
    landmarks_world: np.ndarray = NO_LANDMARKS,
) -> RgbdImage:
    """A new keyframe's image with guesses."""
    none = np.zeros((2, 3), np.float32)
    request = SeedRequest(image, T_world_camera, image.depth_m == 0, landmarks_world, none)
    return guessed_depth.with_guesses(request, sightings, keyframes, config).image


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


def points_at(depth_m: float, columns: np.ndarray) -> np.ndarray:
    """Landmarks of one depth in the image's middle row."""
    x = (columns - CAMERA.cx) / CAMERA.fx * depth_m
    return np.column_stack([x, np.zeros(len(columns)), np.full(len(columns), depth_m)])


def test_a_hole_with_landmarks_has_their_depth(image):
    landmarks = points_at(4.0, np.arange(70, 90))

    filled = with_guesses(image, np.eye(4), *seeing(2.0), AnchorConfig(), landmarks)

    np.testing.assert_allclose(filled.depth_m[60, 70:90], 4.0, rtol=1e-5)
    assert (filled.depth_m[HOLE] > 2.0).all()
    assert filled.depth_m[50:70, 65:95].mean() > 2.5


def test_an_image_without_depth_has_that_of_its_landmarks(image):
    empty = dataclasses.replace(image, depth_m=np.zeros_like(image.depth_m))

    filled = with_guesses(
        empty, np.eye(4), *seeing(4.0), AnchorConfig(), points_at(4.0, np.arange(0, 160, 8))
    )

    np.testing.assert_allclose(filled.depth_m, 4.0, rtol=1e-4)


def test_a_landmark_far_from_those_around_it_is_taken_for_wrong(image):
    empty = dataclasses.replace(image, depth_m=np.zeros_like(image.depth_m))
    landmarks = points_at(4.0, np.arange(0, 160, 8))
    landmarks[10] *= 0.3  # along its ray

    filled = with_guesses(empty, np.eye(4), *seeing(4.0), AnchorConfig(), landmarks)

    np.testing.assert_allclose(filled.depth_m, 4.0, rtol=1e-4)


def test_readings_go_before_landmarks(image):
    landmarks = points_at(4.0, np.arange(5, 40))

    filled = with_guesses(image, np.eye(4), *seeing(2.0), AnchorConfig(), landmarks)

    np.testing.assert_array_equal(filled.depth_m[:, :50], 2.0)


def test_landmarks_behind_and_beside_the_image_are_left_out(image):
    landmarks = np.array([[0.0, 0.0, -3.0], [9.0, 0.0, 3.0], [0.0, -9.0, 3.0]])

    filled = with_guesses(image, np.eye(4), *seeing(2.0), AnchorConfig(), landmarks)

    np.testing.assert_allclose(filled.depth_m, 2.0)


def test_of_many_keyframes_those_that_face_the_points_are_asked(image):
    sightings, keyframes = seeing(*[2.0] * (MAX_FACING + 3))
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    turned = [
        TrainingView(k.seq, k.t_ns, k.frame, behind if k.seq < 3 else np.eye(4)) for k in keyframes
    ]

    chosen = sightings.facing(np.array([[0.0, 0.0, 2.0]]), turned)

    assert [k.seq for k in chosen] == list(range(3, MAX_FACING + 3))
