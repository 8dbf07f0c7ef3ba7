"""Intel RealSense cameras, by pyrealsense2 (extra `realsense`).

Depth is sent as the sensor has it, with both cameras' calibration: registering it to colour is the
service's work, not the host's.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from pointslam.bridges.source import CameraFrame
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import ConfigError, UnavailableError
from shared.se3 import Matrix

WIDTH, HEIGHT, RATE_HZ = 640, 480, 30
_NS_PER_MS = 1_000_000
_FISHEYE = ("kannala_brandt4", "ftheta")


class RealSense:
    """The first camera that is plugged in, or the one with a serial number.

    Raises:
        ConfigError: pyrealsense2 is not installed.
        UnavailableError: there is no camera, or it does not offer 640x480 at 30 Hz.
    """

    def __init__(self, serial: str | None = None) -> None:
        try:
            rs = importlib.import_module("pyrealsense2")
        except ImportError as error:
            install = "a RealSense needs: pip install 'pointslam[realsense]'"
            raise ConfigError(f"{install} ({error})") from None
        self._pipeline, config = rs.pipeline(), rs.config()
        if serial is not None:
            config.enable_device(serial)
        config.enable_stream(rs.stream.depth, WIDTH, HEIGHT, rs.format.z16, RATE_HZ)
        config.enable_stream(rs.stream.color, WIDTH, HEIGHT, rs.format.rgb8, RATE_HZ)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise UnavailableError(f"no RealSense camera could be started ({error})") from None
        colour, depth = (
            profile.get_stream(stream).as_video_stream_profile()
            for stream in (rs.stream.color, rs.stream.depth)
        )
        metres_per_unit = profile.get_device().first_depth_sensor().get_depth_scale()
        self.calibration = Calibration(
            camera_of(colour.get_intrinsics()),
            1.0 / metres_per_unit,
            camera_of(depth.get_intrinsics()),
            matrix_of(depth.get_extrinsics_to(colour)),
        )

    def frames(self) -> Iterator[CameraFrame]:
        """Frames with both images; times are the camera's clock."""
        while True:
            both = self._pipeline.wait_for_frames()
            colour, depth = both.get_color_frame(), both.get_depth_frame()
            if colour and depth:
                t_ns = round(colour.get_timestamp() * _NS_PER_MS)
                rgb, raw = (np.array(image.get_data()) for image in (colour, depth))
                yield CameraFrame(t_ns, rgb, raw)

    def close(self) -> None:
        """Stop streaming."""
        self._pipeline.stop()


def camera_of(intrinsics: Any) -> Camera:
    """A librealsense `intrinsics` as our camera.

    Its Brown-Conrady models, the inverse one too, are taken as OpenCV's, as its ROS driver does:
    the inverse model's coefficients are those of the calibration and small.
    """
    size = intrinsics.width, intrinsics.height
    focal, centre = (intrinsics.fx, intrinsics.fy), (intrinsics.ppx, intrinsics.ppy)
    coefficients = tuple(float(k) for k in intrinsics.coeffs)
    is_fisheye = str(intrinsics.model).rpartition(".")[2] in _FISHEYE
    if not any(coefficients):
        coefficients = ()
    elif is_fisheye:
        coefficients = coefficients[:4]
    return Camera(Intrinsics(*focal, *centre, *size), coefficients, is_fisheye)


def matrix_of(extrinsics: Any) -> Matrix:
    """A librealsense `extrinsics` (rotation by columns, metres) as `T_target_source`."""
    T = np.eye(4)
    T[:3, :3] = np.reshape(extrinsics.rotation, (3, 3), order="F")
    T[:3, 3] = extrinsics.translation
    return T
