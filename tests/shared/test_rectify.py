import numpy as np
import pytest

from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage, Frame
from shared.rectify import rectify, rectify_images, register_depth
from shared.se3 import from_rotation

COLOUR = Intrinsics(100.0, 100.0, 31.5, 23.5, 64, 48)
SIDEWAYS = from_rotation(np.eye(3), [0.1, 0.0, 0.0])


def frame(rgb: np.ndarray, depth_raw: np.ndarray) -> Frame:
    return Frame(
        seq=0,
        t_ns=0,
        rgb=ColourImage(ColourEncoding.RGB8, rgb.tobytes()),
        depth=DepthImage(DepthEncoding.RAW16, depth_raw.astype("<u2").tobytes()),
    )


def test_without_distortion_images_come_back_as_they_are():
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    depth_raw = np.full((48, 64), 1500)

    image = rectify(frame(rgb, depth_raw), Calibration(Camera(COLOUR), 1000.0))

    np.testing.assert_array_equal(image.rgb, rgb)
    np.testing.assert_allclose(image.depth_m, 1.5)


@pytest.mark.parametrize("raw", [0, 65535, 30000])
def test_no_reading_and_readings_beyond_the_range_are_zero(raw):
    rgb = np.zeros((48, 64, 3), np.uint8)

    image = rectify(frame(rgb, np.full((48, 64), raw)), Calibration(Camera(COLOUR), 1000.0))

    assert (image.depth_m == 0.0).all()


def test_depth_of_the_same_camera_is_unchanged():
    depth = np.random.default_rng(1).uniform(1.0, 2.0, (48, 64)).astype(np.float32)

    np.testing.assert_allclose(register_depth(depth, COLOUR, COLOUR, np.eye(4)), depth, rtol=1e-6)


def test_a_baseline_moves_a_wall_by_its_disparity():
    depth = np.zeros((48, 64), np.float32)
    depth[:, 20] = 2.0  # 100 px * 0.1 m / 2 m = 5 px

    registered = register_depth(depth, COLOUR, COLOUR, SIDEWAYS)

    assert np.flatnonzero(registered.any(axis=0)).tolist() == [25]
    np.testing.assert_allclose(registered[:, 25], 2.0)


def test_the_nearest_surface_wins():
    depth = np.full((48, 64), 4.0, np.float32)
    depth[:, 10:30] = 1.0

    registered = register_depth(depth, COLOUR, COLOUR, SIDEWAYS)

    assert (registered[:, 20:40] == 1.0).all()


def test_a_finer_target_has_no_grid_of_holes():
    fine = COLOUR.scaled(2.0)

    registered = register_depth(np.full((48, 64), 2.0, np.float32), COLOUR, fine, np.eye(4))

    assert (registered[2:-2, 2:-2] > 0.0).all()


def test_points_behind_the_colour_camera_are_dropped():
    behind = from_rotation(np.eye(3), [0.0, 0.0, -5.0])

    registered = register_depth(np.full((48, 64), 2.0, np.float32), COLOUR, COLOUR, behind)

    assert (registered == 0.0).all()


def test_a_separate_depth_camera_is_registered():
    small = Intrinsics(50.0, 50.0, 15.5, 11.5, 32, 24)
    calibration = Calibration(Camera(COLOUR), 1000.0, depth=Camera(small))

    image = rectify_images(
        np.zeros((48, 64, 3), np.uint8), np.full((24, 32), 2.0, np.float32), calibration
    )

    assert image.depth_m.shape == (48, 64)
    np.testing.assert_allclose(image.depth_m[5:-5, 5:-5], 2.0)


@pytest.mark.parametrize("fisheye", [False, True])
def test_distortion_leaves_the_centre_in_place_and_pulls_the_corners(fisheye):
    camera = Camera(COLOUR, (-0.3, 0.05, 0.0, 0.0), fisheye)
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[:, :, 0] = np.arange(64) * 4

    image = rectify_images(rgb, np.ones((48, 64), np.float32), Calibration(camera, 1000.0))

    assert abs(int(image.rgb[23, 31, 0]) - 124) <= 4
    corner = image.rgb[:10, :10, 0].astype(int) - rgb[:10, :10, 0]
    assert np.abs(corner).max() > 4


def test_depth_is_not_blended_across_edges():
    camera = Camera(COLOUR, (0.3, 0.05, 0.0, 0.0))
    depth = np.ones((48, 64), np.float32)
    depth[:, 32:] = 3.0

    image = rectify_images(np.zeros((48, 64, 3), np.uint8), depth, Calibration(camera, 1000.0))

    assert set(np.unique(image.depth_m).tolist()) <= {0.0, 1.0, 3.0}


def test_a_damaged_image_is_refused_by_name():
    broken = frame(np.zeros((48, 63, 3), np.uint8), np.ones((48, 64)))

    with pytest.raises(InputError, match="rgb.bytes"):
        rectify(broken, Calibration(Camera(COLOUR), 1000.0))
