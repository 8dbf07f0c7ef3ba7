"""What no device is like is refused by name, before anything is computed with it."""

from dataclasses import replace

import numpy as np
import pytest

from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import InputError
from shared.se3 import exp

CAMERA = Camera(Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480))
KINECT = Calibration(
    CAMERA, 1000.0, depth=CAMERA, T_colour_depth=exp([-0.025, 0.001, 0.002, 0.01, 0.02, -0.01])
)


def changed(**entries: float) -> np.ndarray:
    """The Kinect's transform with other numbers, named by row and column."""
    T = KINECT.T_colour_depth.copy()
    for place, value in entries.items():
        T[int(place[1]), int(place[2])] = value
    return T


def test_two_cameras_of_one_device_are_accepted():
    KINECT.check()


@pytest.mark.parametrize(
    ("T_colour_depth", "reason"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "rotation"),
        (changed(_03=-25.0), "millimetres"),
        (changed(_30=0.5), "0 0 0 1"),
        (changed(_13=np.nan), "finite"),
    ],
    ids=["mirrored", "in millimetres", "projective", "no number"],
)
def test_a_transform_between_cameras_that_is_none_is_refused(T_colour_depth, reason):
    with pytest.raises(InputError, match=rf"calibration\.T_colour_depth.*{reason}"):
        replace(KINECT, T_colour_depth=T_colour_depth).check()
