"""The gRPC services of sessions, poses and maps, on the same sessions as HTTP."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

from services.gateway.create_request import CreateRequest
from services.gateway.grpc_errors import refusing
from services.gateway.map_queries import ask_render, export_pieces
from services.gateway.pose_watch import correction, follow, watched
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from services.gateway.views import View, mean_confidence
from services.gateway.wire_values import (
    calibration_from,
    chosen,
    intrinsics_from,
    matrix_from,
    pose_from,
    require,
    timed_pose_to,
)
from shared.maps import ExportFormat, RenderRequest
from shared.wire import (
    map_service_pb2,
    map_service_pb2_grpc,
    pose_service_pb2,
    pose_service_pb2_grpc,
    session_service_pb2,
    session_service_pb2_grpc,
    types_pb2,
)

_MODES = {
    types_pb2.SESSION_MODE_UNSPECIFIED: "live",
    types_pb2.SESSION_MODE_LIVE: "live",
    types_pb2.SESSION_MODE_OFFLINE: "offline",
}
_MODE_VALUES = {mode: value for value, mode in _MODES.items()}
_CONTENTS = {
    map_service_pb2.VIEW_CONTENT_UNSPECIFIED: "colour",
    map_service_pb2.VIEW_CONTENT_COLOUR: "colour",
    map_service_pb2.VIEW_CONTENT_DEPTH: "depth",
    map_service_pb2.VIEW_CONTENT_ALPHA: "alpha",
    map_service_pb2.VIEW_CONTENT_CONFIDENCE: "confidence",
}
_IMAGES = {
    map_service_pb2.IMAGE_FORMAT_UNSPECIFIED: "jpeg",
    map_service_pb2.IMAGE_FORMAT_JPEG: "jpeg",
    map_service_pb2.IMAGE_FORMAT_PNG: "png",
}
_IMAGE_VALUES = {name: value for value, name in _IMAGES.items()}
_FORMATS = {
    map_service_pb2.MAP_FORMAT_UNSPECIFIED: ExportFormat.PLY,
    map_service_pb2.MAP_FORMAT_PLY: ExportFormat.PLY,
    map_service_pb2.MAP_FORMAT_MESH: ExportFormat.MESH,
    map_service_pb2.MAP_FORMAT_SNAPSHOT: ExportFormat.SNAPSHOT,
    map_service_pb2.MAP_FORMAT_SPZ: ExportFormat.SPZ,
    map_service_pb2.MAP_FORMAT_GLB: ExportFormat.GLB,
    map_service_pb2.MAP_FORMAT_MESH_GLB: ExportFormat.MESH_GLB,
    map_service_pb2.MAP_FORMAT_POINTS: ExportFormat.POINTS,
}


class SessionService(session_service_pb2_grpc.SessionServiceServicer):
    """Create, find, list and delete sessions."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions

    async def CreateSession(self, request: Any, context: Any) -> Any:
        """A new session."""
        async with refusing(context):
            has_pose = request.HasField("T_map_first")
            create = CreateRequest(
                calibration=calibration_from(require(request, "calibration")),
                name=request.session_id or None,
                mode=chosen(request.mode, _MODES, "mode"),
                seed=request.seed,
                T_map_first=pose_from(request.T_map_first) if has_pose else None,
            )
            session = await self._sessions.create(create)
            return session_service_pb2.CreateSessionResponse(session=await self._state(session))

    async def GetSession(self, request: Any, context: Any) -> Any:
        """One session's state."""
        async with refusing(context):
            session = await self._sessions.get(request.session_id)
            return session_service_pb2.GetSessionResponse(session=await self._state(session))

    async def ListSessions(self, request: Any, context: Any) -> Any:
        """All sessions."""
        async with refusing(context):
            rows = [
                session_service_pb2.Session(
                    session_id=row["session"],
                    mode=_MODE_VALUES[row["mode"]],
                    created_ns=row["created_ns"],
                    mapper=row["mapper"],
                    keyframes=row["keyframes"],
                    last_seq=-1,
                    last_t_ns=-1,
                )
                for row in await self._sessions.list()
            ]
            return session_service_pb2.ListSessionsResponse(sessions=rows)

    async def DeleteSession(self, request: Any, context: Any) -> Any:
        """Remove a session."""
        async with refusing(context):
            await self._sessions.delete(request.session_id)
            return session_service_pb2.DeleteSessionResponse()

    async def _state(self, session: Session) -> session_service_pb2.Session:
        info = await self._sessions.info(session)
        tracking = info["tracking"]
        return session_service_pb2.Session(
            session_id=session.name,
            mode=_MODE_VALUES[info["mode"]],
            created_ns=session.created_ns,
            mapper=info["mapper"],
            keyframes=info["keyframes"],
            last_seq=tracking["last_seq"],
            last_t_ns=tracking["last_t_ns"],
            credit=tracking["credit"],
        )


class PoseService(pose_service_pb2_grpc.PoseServiceServicer):
    """Poses for those who do not send the frames."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions

    async def GetPose(self, request: Any, context: Any) -> Any:
        """The newest pose."""
        async with refusing(context):
            session = await self._sessions.get(request.session_id)
            T_map_odom = correction(session.prior, session.owner.keyframes)
            pose = timed_pose_to(session.pose(), T_map_odom)
            return pose_service_pb2.GetPoseResponse(pose=pose)

    async def GetPoseAt(self, request: Any, context: Any) -> Any:
        """The pose at a time."""
        async with refusing(context):
            pose = (await self._sessions.get(request.session_id)).pose(request.t_ns)
            return pose_service_pb2.GetPoseAtResponse(pose=timed_pose_to(pose))

    async def WatchPoses(self, request: Any, context: Any) -> AsyncIterator[Any]:
        """Each new pose, and the newest again when the map has moved it."""
        async with refusing(context):
            session = await self._sessions.get(request.session_id)
            look_every_s = self._sessions.fabric.config.stream.event_interval_s
            with watched(session) as poses:
                await context.send_initial_metadata(())  # from here on no pose is missed
                async for news in follow(session, poses, look_every_s):
                    if not self._sessions.is_serving(session):
                        return
                    if news is not None:
                        pose = timed_pose_to(news.pose, news.T_map_odom)
                        yield pose_service_pb2.WatchPosesResponse(
                            pose=pose, is_correction=news.is_correction
                        )


class MapService(map_service_pb2_grpc.MapServiceServicer):
    """The map's state, views of it, and the map as a file."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions

    async def GetMapInfo(self, request: Any, context: Any) -> Any:
        """State of the map."""
        async with refusing(context):
            info = await self._sessions.info(await self._sessions.get(request.session_id))
            fields = map_service_pb2.GetMapInfoResponse.DESCRIPTOR.fields_by_name
            values = {name: info[name] for name in fields if name != "session_id"}
            return map_service_pb2.GetMapInfoResponse(session_id=info["session"], **values)

    async def RenderView(self, request: Any, context: Any) -> Any:
        """A view as an image."""
        async with refusing(context):
            session = await self._sessions.get(request.session_id)
            view = _view(request, session)
            view.check(self._sessions.fabric.config.limits.max_render_pixels)
            reply = await ask_render(session, view.request, self._sessions.fabric.config)
            return map_service_pb2.RenderViewResponse(
                map_revision=reply.revision,
                format=_IMAGE_VALUES[view.format],
                image=await asyncio.to_thread(view.encode, reply),
                confidence=mean_confidence(reply),
                state=reply.state,
            )

    async def ExportMap(self, request: Any, context: Any) -> AsyncIterator[Any]:
        """The map as a file, in pieces."""
        async with refusing(context):
            session = await self._sessions.get(request.session_id)
            format = chosen(request.format, _FORMATS, "format")
            async for piece in export_pieces(session, format, self._sessions.fabric.config):
                yield map_service_pb2.ExportMapResponse(
                    offset=piece.offset, total=piece.total, bytes=piece.bytes
                )


def _view(request: Any, session: Session) -> View:
    camera = session.calibration.colour.intrinsics
    if request.HasField("intrinsics"):
        camera = intrinsics_from(request.intrinsics)
    is_timed = request.HasField("appearance_t_ns")
    T_map_camera = matrix_from(require(request, "T_map_camera"), "T_map_camera")
    return View(
        RenderRequest(T_map_camera, camera, request.appearance_t_ns if is_timed else None),
        chosen(request.content, _CONTENTS, "content"),
        chosen(request.format, _IMAGES, "format"),
    )
