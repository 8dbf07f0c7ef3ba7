"""Cameras: pinhole intrinsics, distortion, and the calibration of an RGB-D device.

Intrinsics follow OpenCV: the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shared.errors import InputError

MAX_IMAGE_SIDE_PX = 8192
MAX_IMAGE_PX = 1 << 24  # of one image: a worker holds several arrays of this size
_MAX_BASELINE_M = 2.0  # between the two cameras of a device


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, factor: float) -> Intrinsics:
        """The same camera at another resolution (pixel centres at whole numbers)."""
        return Intrinsics(
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
            width=round(self.width * factor),
            height=round(self.height * factor),
        )

    def check(self, where: str = "intrinsics") -> None:
        """Refuse what no camera has.

        Raises:
            InputError: names the field, what was found and what would do.
        """
        for name, side in (("width", self.width), ("height", self.height)):
            if not 16 <= side <= MAX_IMAGE_SIDE_PX:
                raise InputError(
                    f"{where}.{name}", f"must be 16 to {MAX_IMAGE_SIDE_PX} px, got {side}"
                )
        if self.width * self.height > MAX_IMAGE_PX:
            found = f"{self.width}x{self.height}"
            raise InputError(f"{where}.width", f"at most {MAX_IMAGE_PX} pixels, got {found}")
        for name, focal in (("fx", self.fx), ("fy", self.fy)):
            if not (math.isfinite(focal) and 1.0 <= focal <= 1e5):
                raise InputError(f"{where}.{name}", f"must be 1 to 100000 px, got {focal}")
        for name, centre, side in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if not (math.isfinite(centre) and -side <= centre <= 2 * side):
                raise InputError(
                    f"{where}.{name}", f"must lie near the image of {side} px, got {centre}"
                )


@dataclass(frozen=True)
class Camera:
    """A pinhole with OpenCV distortion (k1 k2 p1 p2 [k3 [k4 k5 k6]]), empty when there is none."""

    intrinsics: Intrinsics
    distortion: tuple[float, ...] = ()
    fisheye: bool = False  # the four-parameter model of cv2.fisheye instead

    def check(self, where: str) -> None:
        """Refuse impossible parameters with an InputError that names the field."""
        self.intrinsics.check(where)
        allowed = (0, 4) if self.fisheye else (0, 4, 5, 8)
        if len(self.distortion) not in allowed:
            raise InputError(
                f"{where}.distortion", f"must have {allowed} numbers, got {len(self.distortion)}"
            )
        if not all(math.isfinite(k) for k in self.distortion):
            raise InputError(f"{where}.distortion", f"must be finite, got {self.distortion}")


@dataclass(frozen=True)
class Calibration:
    """An RGB-D device: what turns its images into metric points in the colour camera.

    `depth` is the depth camera where depth is not registered to colour; then `T_colour_depth`
    maps points of the depth camera to the colour camera. Depth in metres is raw / depth_scale.
    """

    colour: Camera
    depth_scale: float
    depth: Camera | None = None
    T_colour_depth: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    max_depth_m: float = 20.0

    def depth_camera(self) -> Camera:
        """The camera whose pixels the depth image has."""
        return self.depth or self.colour

    def check(self) -> None:
        """Refuse impossible parameters with an InputError that names the field."""
        self.colour.check("calibration.colour")
        if self.depth is not None:
            self.depth.check("calibration.depth")
        if not (math.isfinite(self.depth_scale) and 1.0 <= self.depth_scale <= 1e6):
            raise InputError(
                "calibration.depth_scale",
                f"must be 1 to 1e6 units per metre, got {self.depth_scale}",
            )
        if not (math.isfinite(self.max_depth_m) and 0.1 <= self.max_depth_m <= 1000.0):
            raise InputError(
                "calibration.max_depth_m", f"must be 0.1 to 1000, got {self.max_depth_m}"
            )
        _check_rigid(self.T_colour_depth)


def _check_rigid(T: NDArray[np.float64]) -> None:
    name = "calibration.T_colour_depth"
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(name, f"must be 4x4 finite numbers, got shape {T.shape}")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0.0:
        raise InputError(name, "its 3x3 block must be a rotation")
    if np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise InputError(name, f"must end with the row 0 0 0 1, got {T[3].tolist()}")
    if np.abs(T[:3, 3]).max() > _MAX_BASELINE_M:
        found = f"got {T[:3, 3].tolist()}: are they millimetres?"
        raise InputError(name, f"must shift by at most {_MAX_BASELINE_M:g} m, {found}")
