"""A frame blurred by motion is known by its edges, whatever it shows and however it is exposed."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.true_sequence import TrueSequence
from services.tracking.config import KeyframeRuleConfig
from services.tracking.keyframes import Coverage, Sharpness, is_too_blurred, sharpness_of
from services.tracking.sharpness import edge_blur_px, gradients
from shared.camera import Intrinsics
from shared.images import decode_colour
from shared.se3 import exp

VGA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
BESIDE = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
DATA = Path(os.environ.get("POINTSLAM_DATA", BESIDE))
SETS = ("house-living", "house-sparse", "kitchen-real", "office-hololens")


def motion_blurred(rgb: np.ndarray, length_px: float, angle_rad: float) -> np.ndarray:
    """As if the camera had moved by so many pixels while it was open."""
    size = 2 * int(np.ceil(length_px / 2)) + 3
    line = np.zeros((size, size), np.float32)
    along = np.arange(size) - size // 2
    line[size // 2] = np.clip(length_px / 2 - np.abs(along) + 0.5, 0.0, 1.0)
    centre = (size / 2 - 0.5, size / 2 - 0.5)
    line = cv2.warpAffine(
        line, cv2.getRotationMatrix2D(centre, np.degrees(angle_rad), 1.0), (size, size)
    )
    return cv2.filter2D(rgb, -1, line / line.sum()).astype(np.uint8)


def checks(cell_px: int, low: int = 60, high: int = 190) -> np.ndarray:
    """Slanted squares, with the softness of a lens."""
    v, u = np.mgrid[0:480, 0:640]
    a, b = (u + 0.3 * v) // cell_px, (v - 0.3 * u) // cell_px
    grey = np.where((a + b) % 2 == 0, low, high).astype(np.uint8)
    return np.repeat(cv2.GaussianBlur(grey, (0, 0), 0.8)[..., None], 3, axis=-1)


@pytest.mark.parametrize("length_px", [8.0, 12.0, 20.0])
@pytest.mark.parametrize("angle_rad", [0.0, 0.7, 1.6, 2.5])
def test_the_blur_of_a_motion_is_seen_in_any_direction(length_px, angle_rad):
    image = motion_blurred(checks(60), length_px, angle_rad)

    assert edge_blur_px(image) > 2.0


@pytest.mark.parametrize("cell_px", [25, 60, 150])
@pytest.mark.parametrize(("low", "high"), [(60, 190), (30, 95), (100, 130)])
def test_sharp_edges_are_about_a_pixel_wide_whatever_the_scene_and_exposure(cell_px, low, high):
    assert 0.5 < edge_blur_px(checks(cell_px, low, high)) < 1.3


@pytest.mark.parametrize("shape", [(48, 64), (49, 65), (2, 3)])
def test_gradients_are_those_of_every_second_pixel_that_opencv_finds(shape):
    image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)

    x, y = gradients(image)

    np.testing.assert_array_equal(x, cv2.Sobel(image, cv2.CV_16S, 1, 0)[::2, ::2])
    np.testing.assert_array_equal(y, cv2.Sobel(image, cv2.CV_16S, 0, 1)[::2, ::2])


def test_an_image_without_edges_has_no_blur_to_speak_of():
    assert edge_blur_px(np.full((480, 640, 3), 90, np.uint8)) == 0.0


def covered(
    overlap: float, landmarks: int = 300, turn_deg: float = 0.0, step_deg: float = 0.0
) -> Coverage:
    T_reference_camera = exp([0.0, 0.0, 0.0, 0.0, np.radians(turn_deg), 0.0])
    return Coverage(9000, overlap, landmarks, 0.5, T_reference_camera, 2.0, step_deg)


@pytest.mark.parametrize(("edge_blur", "refused"), [(1.2, False), (1.8, False), (2.4, True)])
def test_a_frame_is_too_blurred_beside_the_keyframes_around(edge_blur, refused):
    sharpness = Sharpness(edge_blur, usual_blur_px=1.1)

    assert is_too_blurred(sharpness, covered(0.7), VGA, KeyframeRuleConfig()) == refused


def test_a_lens_that_is_always_soft_is_no_reason_to_refuse():
    sharpness = Sharpness(2.6, usual_blur_px=2.5)

    assert not is_too_blurred(sharpness, covered(0.7), VGA, KeyframeRuleConfig())


def test_where_the_map_is_about_to_end_a_blurred_keyframe_is_better_than_none():
    sharpness = Sharpness(4.0, usual_blur_px=1.1)

    assert not is_too_blurred(sharpness, covered(0.3), VGA, KeyframeRuleConfig())


def test_where_hardly_any_landmark_is_left_a_blurred_keyframe_is_better_than_none():
    sharpness = Sharpness(4.0, usual_blur_px=1.1)

    assert not is_too_blurred(sharpness, covered(0.7, landmarks=60), VGA, KeyframeRuleConfig())


@pytest.mark.parametrize(("step_deg", "refused"), [(1.0, True), (13.0, False)])
def test_a_blurred_keyframe_is_better_than_none_where_the_next_turn_leaves_the_map(
    step_deg, refused
):
    coverage = covered(0.7, turn_deg=18.0, step_deg=step_deg)

    is_refused = is_too_blurred(Sharpness(4.0, 1.1), coverage, VGA, KeyframeRuleConfig())

    assert is_refused == refused


def test_without_keyframes_of_known_blur_a_frame_is_its_own_measure():
    assert sharpness_of(4.0, ()).added_blur_px == 0.0


def real_images(name: str) -> list[np.ndarray]:
    """Five images, evenly from a sequence."""
    sequence = TrueSequence(DATA / name)
    indices = range(0, len(sequence), len(sequence) // 5)[:5]
    size = sequence.calibration.colour.intrinsics
    return [decode_colour(sequence.frame(index).rgb, size) for index in indices]


@pytest.mark.skipif(not DATA.is_dir(), reason="no sequences in $POINTSLAM_DATA or ../shared/data")
@pytest.mark.parametrize("name", SETS)
def test_real_frames_blurred_by_ten_pixels_stand_out_from_all_sharp_ones(name):
    images = real_images(name)
    usual = float(np.median([edge_blur_px(image) for image in images]))

    added = [
        Sharpness(edge_blur_px(motion_blurred(image, 10.0, 0.3 + n)), usual).added_blur_px
        for n, image in enumerate(images)
    ]

    assert min(added) > KeyframeRuleConfig().max_added_blur_px


@pytest.mark.skipif(not DATA.is_dir(), reason="no sequences in $POINTSLAM_DATA or ../shared/data")
@pytest.mark.parametrize("gain", [0.5, 1.5])
@pytest.mark.parametrize("name", ["house-living", "house-sparse"])
def test_sharp_frames_pass_at_another_exposure(name, gain):
    images = real_images(name)
    usual = float(np.median([edge_blur_px(image) for image in images]))

    exposed = [cv2.convertScaleAbs(image, alpha=gain).astype(np.uint8) for image in images]
    added = [Sharpness(edge_blur_px(image), usual).added_blur_px for image in exposed]

    assert max(added) < KeyframeRuleConfig().max_added_blur_px
