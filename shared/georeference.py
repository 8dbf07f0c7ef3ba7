"""Where on Earth a map is: its frame in a local east-north-up frame (WGS 84).

Ellipsoid and formulas: EPSG method 9602 (geographic and geocentric), EPSG method 9837 (local
topocentric axes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shared import se3
from shared.errors import InputError

Vector = NDArray[np.float64]

_SEMI_MAJOR_M = 6_378_137.0
_FLATTENING = 1.0 / 298.257223563
_E2 = _FLATTENING * (2.0 - _FLATTENING)
_MAX_HEIGHT_M = 100_000.0


@dataclass(frozen=True)
class GeoPosition:
    """A point in WGS 84: degrees, and metres above the ellipsoid."""

    lat: float
    lon: float
    h: float

    def check(self) -> None:
        """Refuse what is no place near the ground with an InputError that names the field."""
        for name, low, high in (("lat", -90.0, 90.0), ("lon", -180.0, 180.0)):
            if not low <= getattr(self, name) <= high:
                raise InputError(name, f"must be {low:g} to {high:g} degrees")
        if not abs(self.h) <= _MAX_HEIGHT_M:
            raise InputError("h", f"must be within {_MAX_HEIGHT_M:g} m of the ellipsoid")


@dataclass(frozen=True)
class Georeference:
    """A map's frame in the east-north-up frame at a position."""

    position: GeoPosition
    T_enu_map: NDArray[np.float64]  # [4, 4]


@dataclass(frozen=True)
class GeoreferenceRequest:
    """Ask for a session's georeference, or give it one."""

    new: Georeference | None = None


@dataclass(frozen=True)
class GeoreferenceReply:
    """The georeference that a session has; None where it was given none."""

    georeference: Georeference | None = None


@dataclass(frozen=True)
class GeoPose:
    """A pose on Earth: the rotation takes the camera's axes to east, north and up where it is."""

    position: GeoPosition
    R_enu_camera: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))  # [3, 3]


def T_enu_map_of_heading(heading_deg: float) -> NDArray[np.float64]:
    """The map of a first camera that was held level and looked at a compass heading, [4, 4].

    Columns are the camera's axes (right, down, forward) in east, north, up.
    """
    sine, cosine = math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))
    T = np.eye(4)
    T[:3, :3] = [[cosine, 0.0, sine], [-sine, 0.0, cosine], [0.0, -1.0, 0.0]]
    return T


def geo_pose(georeference: Georeference, T_map_camera: NDArray[np.float64]) -> GeoPose:
    """A camera of the map, on Earth; east, north and up are those at the camera."""
    T_enu_camera = georeference.T_enu_map @ T_map_camera
    origin = georeference.position
    R_ecef_enu = _R_ecef_enu(origin.lat, origin.lon)
    position = _position(_ecef(origin) + R_ecef_enu @ T_enu_camera[:3, 3])
    # Over 100 m the axes turn by a thousandth of a degree; over a campus it is seen.
    R_here_enu = _R_ecef_enu(position.lat, position.lon).T @ R_ecef_enu
    return GeoPose(position, R_here_enu @ T_enu_camera[:3, :3])


def quaternion_of(pose: GeoPose) -> se3.Quaternion:
    """The rotation as OGC GeoPose's Basic-Quaternion spells it."""
    return se3.Quaternion(*se3.quat_xyzw_from_rotation(pose.R_enu_camera))


def _ecef(position: GeoPosition) -> Vector:
    """Earth-centred, earth-fixed coordinates, metres, [3]."""
    lat, lon = math.radians(position.lat), math.radians(position.lon)
    normal_m = _SEMI_MAJOR_M / math.sqrt(1.0 - _E2 * math.sin(lat) ** 2)
    across_m = (normal_m + position.h) * math.cos(lat)
    z_m = (normal_m * (1.0 - _E2) + position.h) * math.sin(lat)
    return np.array([across_m * math.cos(lon), across_m * math.sin(lon), z_m])


def _position(ecef: Vector) -> GeoPosition:
    """Latitude by fixed-point iteration, which near the ground gains three digits a round."""
    x, y, z = ecef
    across_m = math.hypot(x, y)
    lat = math.atan2(z, across_m * (1.0 - _E2))
    for _ in range(6):
        normal_m = _SEMI_MAJOR_M / math.sqrt(1.0 - _E2 * math.sin(lat) ** 2)
        lat = math.atan2(z + _E2 * normal_m * math.sin(lat), across_m)
    normal_m = _SEMI_MAJOR_M / math.sqrt(1.0 - _E2 * math.sin(lat) ** 2)
    # Good at the poles too, where across / cos(lat) is not.
    h = across_m * math.cos(lat) + z * math.sin(lat) - _SEMI_MAJOR_M**2 / normal_m
    return GeoPosition(math.degrees(lat), math.degrees(math.atan2(y, x)), h)


def _R_ecef_enu(lat: float, lon: float) -> NDArray[np.float64]:
    """East, north and up as columns, [3, 3]."""
    slat, clat = math.sin(math.radians(lat)), math.cos(math.radians(lat))
    slon, clon = math.sin(math.radians(lon)), math.cos(math.radians(lon))
    return np.array(
        [[-slon, -slat * clon, clat * clon], [clon, -slat * slon, clat * slon], [0.0, clat, slat]]
    )
