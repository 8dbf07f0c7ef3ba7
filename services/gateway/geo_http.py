"""HTTP: where on Earth a map is, and its cameras as OGC GeoPoses."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter, Request

from services.gateway import examples
from services.gateway.axes import Axes, camera_in_axes
from services.gateway.decode import matrix_of, plain, read_json
from services.gateway.poses import TimedPose
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from shared import codec
from shared.errors import ConflictError, InputError
from shared.georeference import (
    GeoPose,
    GeoPosition,
    Georeference,
    GeoreferenceReply,
    GeoreferenceRequest,
    T_enu_map_of_heading,
    geo_pose,
    quaternion_of,
)
from shared.se3 import Pose


@dataclass(frozen=True)
class PutGeoreference:
    """The map's origin, and its axes: whole, or by the first camera's compass heading."""

    lat: float
    lon: float
    h: float
    heading_deg: float | None = None
    T_enu_map: Pose | None = None

    def georeference(self) -> Georeference:
        """What is kept of it.

        Raises:
            InputError: names the field that cannot be used.
        """
        position = GeoPosition(self.lat, self.lon, self.h)
        position.check()
        if (self.heading_deg is None) == (self.T_enu_map is None):
            raise InputError("heading_deg", "give this or T_enu_map")
        if self.T_enu_map is not None:
            return Georeference(position, matrix_of(self.T_enu_map, "T_enu_map"))
        heading_deg = self.heading_deg or 0.0
        if not -360.0 <= heading_deg <= 360.0:
            raise InputError("heading_deg", "must be -360 to 360, clockwise from north")
        return Georeference(position, T_enu_map_of_heading(heading_deg))


def geo_routes(sessions: Sessions) -> APIRouter:
    """The routes of georeferences and GeoPoses."""
    router = APIRouter()
    timeout_s = sessions.fabric.config.mapping.question_timeout_s

    async def ask(session: Session, new: Georeference | None = None) -> Georeference:
        request = GeoreferenceRequest(new)
        reply: GeoreferenceReply = await session.owner.ask(
            "georeference", request, GeoreferenceReply, timeout_s
        )
        if reply.georeference is None:
            path = f"/v1/sessions/{session.name}/georeference"
            raise ConflictError(f"session {session.name} has no georeference; PUT {path}")
        return reply.georeference

    @router.put("/v1/sessions/{name}/georeference", openapi_extra=examples.GEOREFERENCE)
    async def put_georeference(name: str, request: Request) -> dict[str, Any]:
        """Say where on Earth the map is; kept with the session, and in its snapshots.

        `heading_deg` is where the first camera looked, clockwise from north, held level;
        `T_enu_map` says it of maps whose first pose was given.
        """
        session = await sessions.get(name)
        put = plain(PutGeoreference, await read_json(request))
        return _georeference_json(await ask(session, put.georeference()))

    @router.get("/v1/sessions/{name}/georeference")
    async def get_georeference(name: str) -> dict[str, Any]:
        """Where on Earth the map is."""
        return _georeference_json(await ask(await sessions.get(name)))

    @router.get("/v1/sessions/{name}/geopose", responses=examples.GEOPOSE)
    async def get_geopose(
        name: str, t_ns: int | None = None, frame: Axes = Axes.OPENCV
    ) -> dict[str, Any]:
        """The newest pose, or that at a time, as OGC GeoPose 1.0 Basic-Quaternion.

        The quaternion takes the camera's axes, of the convention `frame`, to east, north and up.
        Beside the standard's two members it has the accuracy and what `pose` tells of the frame.
        """
        session = await sessions.get(name)
        pose = session.pose(t_ns)
        return _geopose_json(geo_pose(await ask(session), pose.T_map_camera), pose, frame)

    return router


def _georeference_json(georeference: Georeference) -> dict[str, Any]:
    T_enu_map = codec.to_json(Pose.from_matrix(georeference.T_enu_map))
    return codec.to_json(georeference.position) | {"T_enu_map": T_enu_map}


def _geopose_json(geo: GeoPose, pose: TimedPose, axes: Axes) -> dict[str, Any]:
    turned = dataclasses.replace(geo, R_enu_camera=camera_in_axes(geo.R_enu_camera, axes))
    deviation = pose.deviations()
    return {
        "position": codec.to_json(geo.position),
        "quaternion": codec.to_json(quaternion_of(turned)),
        "accuracy": {
            "pos_std_m": deviation[0] if deviation else None,
            "rot_std_deg": deviation[1] if deviation else None,
        },
        "frame": str(axes),
        "t_ns": pose.t_ns,
        "status": str(pose.status),
    }
