"""Is this pose to be believed? What the map says there against what the depth image shows."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import VerificationConfig
from shared.rectify import RgbdImage
from shared.se3 import angle_rad, inverse
from shared.tracks import PointCloud


@dataclass(frozen=True)
class Agreement:
    """Of the map's points that fall into the image: how many lie on the measured surface."""

    share: float  # on the surface, of those not hidden behind it
    visible_share: float  # on the surface, of all that fall into the image
    points: int  # on the surface
    compared: int  # fall where there is depth

    @property
    def is_silent(self) -> bool:
        """Hardly anything could be compared."""
        return self.compared < _MIN_COMPARED

    @property
    def belief(self) -> float:
        """The share; neither for nor against where depth is silent."""
        return 0.5 if self.is_silent else self.share


def depth_agreement(
    image: RgbdImage,
    cloud_world: PointCloud,
    T_world_camera: NDArray[np.float64],
    config: VerificationConfig,
) -> Agreement:
    """Project the map into the depth image. A point in front of the measured surface refutes."""
    i = image.intrinsics
    on, front, behind = _compare(
        image.depth_m,
        cloud_world.points[::_CLOUD_STEP],
        cloud_world.normals[::_CLOUD_STEP],
        inverse(T_world_camera),
        np.array([i.fx, i.fy, i.cx, i.cy]),
        np.array([config.depth_tolerance_m, config.depth_tolerance_per_m2]),
    )
    compared = on + front + behind
    return Agreement(on / max(1, on + front), on / max(1, compared), on, compared)


_MIN_COMPARED = 50  # points of the map; with fewer, depth says nothing
_CLOUD_STEP = 4  # a share needs not all of the points


@dataclass(frozen=True)
class Step:
    """How far apart two poses are."""

    metres: float
    degrees: float

    def is_within(self, limit: Step) -> bool:
        """Neither part exceeds the limit's."""
        return self.metres <= limit.metres and self.degrees <= limit.degrees


def step_between(T_world_a: NDArray[np.float64], T_world_b: NDArray[np.float64]) -> Step:
    """Distance and angle from one pose to another."""
    T_a_b = inverse(T_world_a) @ T_world_b
    return Step(float(np.linalg.norm(T_a_b[:3, 3])), float(np.degrees(angle_rad(T_a_b))))


def is_possible_step(
    T_world_before: NDArray[np.float64],
    T_world_camera: NDArray[np.float64],
    frames: int,
    config: VerificationConfig,
) -> bool:
    """Whether a camera can have moved so far in so many frames."""
    limit = Step(config.max_step_m * frames, config.max_step_deg * frames)
    return step_between(T_world_before, T_world_camera).is_within(limit)


@numba.njit(cache=True, nogil=True)
def _compare(depth, points, normals, T, camera, tolerance):  # noqa: PLR0913 - compiled
    height, width = depth.shape
    on = front = behind = 0
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if z < 0.1:
            continue
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        u = int(np.floor(camera[0] * x / z + camera[2] + 0.5))
        v = int(np.floor(camera[1] * y / z + camera[3] + 0.5))
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        measured = depth[v, u]
        if measured <= 0.0:
            continue
        m = normals[n]
        nx = T[0, 0] * m[0] + T[0, 1] * m[1] + T[0, 2] * m[2]
        ny = T[1, 0] * m[0] + T[1, 1] * m[1] + T[1, 2] * m[2]
        nz = T[2, 0] * m[0] + T[2, 1] * m[1] + T[2, 2] * m[2]
        if nx * x + ny * y + nz * z > -0.17 * np.sqrt(x * x + y * y + z * z):
            continue
        limit = tolerance[0] + tolerance[1] * z * z
        if abs(z - measured) <= limit:
            on += 1
        elif z < measured:
            front += 1
        else:
            behind += 1
    return on, front, behind
