"""What cameras' own libraries say, as our calibration and frames."""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest

from pointslam.bridges import realsense, record3d
from pointslam.cli import main
from shared import se3
from shared.camera import Intrinsics

INTRINSICS = {"fx": 610.0, "fy": 611.0, "ppx": 320.5, "ppy": 239.5, "width": 640, "height": 480}


def test_a_realsense_camera_without_distortion_is_a_pinhole():
    said = SimpleNamespace(**INTRINSICS, model="distortion.brown_conrady", coeffs=[0.0] * 5)

    camera = realsense.camera_of(said)

    assert camera.intrinsics == Intrinsics(610.0, 611.0, 320.5, 239.5, 640, 480)
    assert camera.distortion == ()
    assert not camera.fisheye


def test_a_realsense_fisheye_has_four_coefficients():
    said = SimpleNamespace(
        **INTRINSICS, model="distortion.kannala_brandt4", coeffs=[0.1, 0.2, 0.3, 0.4, 0.0]
    )

    camera = realsense.camera_of(said)

    assert camera.fisheye
    assert camera.distortion == (0.1, 0.2, 0.3, 0.4)


def test_realsense_extrinsics_are_told_by_columns():
    T = se3.exp([0.015, -0.001, 0.002, 0.01, -0.02, 0.03])
    said = SimpleNamespace(rotation=T[:3, :3].T.ravel().tolist(), translation=T[:3, 3].tolist())

    np.testing.assert_allclose(realsense.matrix_of(said), T, atol=1e-15)


def test_an_iphones_depth_is_its_colour_camera_at_a_smaller_size():
    matrix = SimpleNamespace(fx=720.0, fy=720.0, tx=479.5, ty=359.5)

    calibration = record3d.calibration_of(matrix, (720, 960, 3), (192, 256))

    assert calibration.colour.intrinsics.width == 960
    assert calibration.depth is not None
    assert calibration.depth.intrinsics.fx == pytest.approx(720.0 * 256 / 960)
    calibration.check()


def test_depth_that_is_missing_or_too_far_is_no_reading():
    depth_m = np.array([[1.5, np.nan, np.inf, -1.0, 0.0, 20.0]], np.float32)

    raw = record3d.raw_depth(depth_m)

    np.testing.assert_array_equal(raw, [[6000, 0, 0, 0, 0, 0]])


@pytest.mark.parametrize("source", ["realsense", "record3d"])
def test_a_camera_without_its_package_says_what_to_install(source, capsys):
    if find_spec("pyrealsense2" if source == "realsense" else "record3d"):
        pytest.skip(f"the package for {source} is installed")

    assert main(["client", source]) == 2

    assert f"pip install 'pointslam[{source}]'" in capsys.readouterr().err
