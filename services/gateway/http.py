"""HTTP: sessions, frames, poses, trajectories, health."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request
from numpy.typing import NDArray
from starlette.responses import JSONResponse, Response

from services.gateway import examples
from services.gateway.access.caller import current_caller
from services.gateway.axes import Axes, in_axes
from services.gateway.create_request import CreateRequest
from services.gateway.decode import plain, read_frame, read_json
from services.gateway.localizer import read_localize
from services.gateway.pose_watch import correction
from services.gateway.poses import TimedPose
from services.gateway.sessions import Sessions
from services.gateway.trajectory import fetch_trajectory, trajectory_file, trajectory_json
from shared import codec
from shared.errors import UnavailableError
from shared.se3 import Pose
from shared.trajectories import TrajectoryFormat

MSGPACK = "application/msgpack"


def http_routes(sessions: Sessions) -> APIRouter:
    """The routes of sessions and frames."""
    router = APIRouter()
    _add_session_routes(router, sessions)
    _add_pose_routes(router, sessions)
    _add_health_routes(router, sessions)
    return router


def _add_session_routes(router: APIRouter, sessions: Sessions) -> None:
    @router.post("/v1/sessions", status_code=201, openapi_extra=examples.CREATE_SESSION)
    async def create_session(request: Request) -> Response:
        """Create a session with the device's calibration."""
        create = plain(CreateRequest, await read_json(request))
        session = await sessions.create(create)
        location = {"Location": f"/v1/sessions/{session.name}"}
        return JSONResponse(await sessions.info(session), 201, location)

    @router.get("/v1/sessions")
    async def list_sessions() -> dict[str, Any]:
        """All sessions, those on disk too, newest first."""
        return {"sessions": await sessions.list()}

    @router.get("/v1/sessions/{name}")
    async def get_session(name: str) -> dict[str, Any]:
        """State of the session's map and of its tracking."""
        return await sessions.info(await sessions.get(name))

    @router.delete("/v1/sessions/{name}", status_code=204)
    async def delete_session(name: str) -> None:
        """Remove the session and every byte of it."""
        await sessions.delete(name)

    @router.put("/v1/sessions/{name}/pin", status_code=204)
    async def pin_session(name: str) -> None:
        """Keep the session for ever: no rule of retention deletes it."""
        await sessions.pin(name, True)

    @router.delete("/v1/sessions/{name}/pin", status_code=204)
    async def unpin_session(name: str) -> None:
        """Let the rule of retention have the session again."""
        await sessions.pin(name, False)

    @router.post("/v1/sessions/{name}/frames", openapi_extra=examples.POST_FRAME)
    async def post_frame(name: str, request: Request) -> Response:
        """Track one frame: a msgpack FrameMessage in, a FrameReply out (JSON if accepted)."""
        session = await sessions.get(name)
        current_caller().budget.take_frame()
        message = read_frame(await request.body(), session.calibration)
        traceparent = message.traceparent or request.headers.get("traceparent", "")
        message = replace(message, traceparent=traceparent)
        return _reply(request, await session.track(message))

    @router.post("/v1/sessions/{name}/localize", openapi_extra=examples.LOCALIZE)
    async def localize(name: str, request: Request) -> Response:
        """Find one image in the map: a msgpack LocalizeMessage in, a LocalizeReply out (or JSON).

        The map may be of any time; the session's trajectory is not touched. `NOT_LOCALISED` says
        in `reason` why there is no pose, `COLOUR_ONLY` that no depth could confirm it.
        """
        session = await sessions.get(name)
        message = read_localize(await request.body(), session.calibration)
        return _reply(request, await session.localize(message))


def _add_pose_routes(router: APIRouter, sessions: Sessions) -> None:
    @router.get("/v1/sessions/{name}/pose", responses=examples.POSE)
    async def get_pose(
        name: str, t_ns: int | None = None, frame: Axes = Axes.OPENCV
    ) -> dict[str, Any]:
        """The newest pose, or the pose at a time of the client's clock, interpolated.

        `frame` names the axes of camera and map: opencv (right, down, forward), opengl (right, up,
        backward; OpenXR too) or ros (forward, left, up). `T_map_odom` corrects the odometry of a
        device that sends it, as of now.
        """
        session = await sessions.get(name)
        T_map_odom = correction(session.prior, session.owner.keyframes)
        return pose_json(session.pose(t_ns), frame, T_map_odom)

    @router.get("/v1/sessions/{name}/trajectory")
    async def get_trajectory(name: str) -> Response:
        """Every answered frame: status, pose as told, pose in the map as it is now."""
        trajectory = await fetch_trajectory(await sessions.get(name))
        # An hour of frames takes seconds to write; frames go on meanwhile.
        return await asyncio.to_thread(lambda: JSONResponse(trajectory_json(trajectory)))

    @router.get("/v1/sessions/{name}/trajectory.{format}")
    async def get_trajectory_file(
        name: str,
        format: TrajectoryFormat,
        kind: Annotated[str, Query(pattern="^(online|final)$")] = "final",
    ) -> Response:
        """The trajectory as a TUM, KITTI or CSV (EuRoC) file, one line a tracked frame."""
        trajectory = await fetch_trajectory(await sessions.get(name))
        text = await asyncio.to_thread(trajectory_file, trajectory, format, kind)
        return Response(text, media_type="text/plain")


def _add_health_routes(router: APIRouter, sessions: Sessions) -> None:
    @router.get("/healthz")
    async def health() -> dict[str, str]:
        """The process answers."""
        return {"status": "ok"}

    @router.get("/readyz")
    async def ready() -> dict[str, Any]:
        """A session can be created and tracked: a tracking worker and a mapper are alive."""
        members = {
            "trackers": sessions.fabric.trackers.count(),
            "mappers": len(sessions.fabric.mappers.names),
        }
        if not sessions.is_ready():
            counts = ", ".join(f"{count} {role}" for role, count in members.items())
            raise UnavailableError(f"not ready: {counts} alive")
        return {"status": "ready", **members}


def pose_json(
    pose: TimedPose, axes: Axes = Axes.OPENCV, T_map_odom: NDArray[np.float64] | None = None
) -> dict[str, Any]:
    """A pose in some convention's axes as plain JSON values, with named quaternion fields."""
    deviation = pose.deviations()
    return {
        "seq": pose.seq,
        "t_ns": pose.t_ns,
        "status": str(pose.status),
        "frame": str(axes),
        "T_map_camera": _pose_in(pose.T_map_camera, axes),
        "T_map_odom": None if T_map_odom is None else _pose_in(T_map_odom, axes),
        "pos_std_m": deviation[0] if deviation else None,
        "rot_std_deg": deviation[1] if deviation else None,
        "reference_seq": pose.reference_seq,
        "map_revision": pose.map_revision,
        "is_interpolated": pose.is_interpolated,
    }


def _pose_in(T: NDArray[np.float64], axes: Axes) -> dict[str, Any]:
    return codec.to_json(Pose.from_matrix(in_axes(T, axes)))


def _reply(request: Request, reply: object) -> Response:
    """Msgpack, or JSON where that is accepted."""
    if "json" in request.headers.get("accept", ""):
        return JSONResponse(codec.to_json(reply))
    return Response(codec.pack(reply), media_type=MSGPACK)
