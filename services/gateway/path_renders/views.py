"""From what a client asks for to the cameras of every picture."""

from __future__ import annotations

import asyncio
import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.gateway.colour_maps import LAYERS, depth_range
from services.gateway.config import GatewayConfig, LimitsConfig
from services.gateway.decode import MAX_POSITION_M, MAX_T_NS, matrix_of
from services.gateway.map_queries import ask_render
from services.gateway.path_renders.camera_path import orbit, smooth_path, timed_path, upward
from services.gateway.session import Session
from services.gateway.trajectory import fetch_trajectory
from services.gateway.views import intrinsics_from
from shared.camera import Intrinsics
from shared.errors import InputError, NotFoundError
from shared.frames import HAS_POSE
from shared.maps import RenderReply, RenderRequest
from shared.path_renders import PathKind, PathRenderRequest

_MAX_FPS = 240.0
_MAX_TURN_DEG = 3600.0
_TOUR_KEYFRAMES = 24  # a curve through all of them would shake as the hand did
_LOOKS = 8  # along the path, for the range of depth
_LOOK_PX = 96
_LENS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class PathViews:
    """Every view of a path: its cameras and their pixels; of depth, what its colours stand for."""

    request: PathRenderRequest
    size: Intrinsics
    T_map_cameras: NDArray[np.float64]  # [N, 4, 4]
    depth_range_m: tuple[float, float] | None = None

    def render_request(self, i: int) -> RenderRequest:
        """The i-th view as the map's owner draws it."""
        return RenderRequest(self.T_map_cameras[i], self.size, self.request.appearance_t_ns)


def check(request: PathRenderRequest, limits: LimitsConfig) -> None:
    """Refuse what cannot be drawn with an InputError that names the field."""
    for field, value, low, high in (
        ("frames", request.frames, 1, limits.max_path_frames),
        ("fps", request.fps, 1.0, _MAX_FPS),
        ("turn_deg", request.turn_deg, -_MAX_TURN_DEG, _MAX_TURN_DEG),
    ):
        if not (math.isfinite(value) and low <= value <= high):
            raise InputError(field, f"must be {low} to {high}, got {value}")
    if request.layer not in LAYERS:
        raise InputError("layer", f"must be one of {', '.join(LAYERS)}")
    if abs(request.appearance_t_ns or 0) >= MAX_T_NS:
        raise InputError("appearance_t_ns", f"must be less than {MAX_T_NS}")
    if request.path is PathKind.POSES and not request.poses:
        raise InputError("poses", "a path through poses needs some")
    if len(request.poses) > limits.max_path_frames:
        raise InputError("poses", f"must be at most {limits.max_path_frames}")
    _centre(request)


def size_of(request: PathRenderRequest, colour: Intrinsics, max_pixels: int) -> Intrinsics:
    """The pixels of every picture.

    Raises:
        InputError: they are no camera, or too many; names the field.
    """
    if request.intrinsics is not None and request.width is not None:
        raise InputError("width", "goes without intrinsics only")
    size = request.intrinsics
    if size is None:
        size = intrinsics_from(dict.fromkeys(_LENS), request.width, None, colour)
    size.check("intrinsics")
    if size.width * size.height > max_pixels:
        raise InputError("intrinsics.width", f"at most {max_pixels} pixels")
    if min(size.width, size.height) < 2:
        raise InputError("intrinsics.width", "both sides must be at least 2 px")
    return size


async def plan(session: Session, request: PathRenderRequest, config: GatewayConfig) -> PathViews:
    """The cameras of a checked request, in the map as it is now.

    Raises:
        InputError: the request does not fit the session; names the field.
        NotFoundError: the session has no pose yet.
    """
    limits = config.limits
    size = size_of(request, session.calibration.colour.intrinsics, limits.max_render_pixels)
    T_map_cameras = await _cameras(session, request, config)
    views = PathViews(request, size, T_map_cameras)
    if request.layer != "depth":
        return views
    at = np.linspace(0, len(T_map_cameras) - 1, _LOOKS).round().astype(int)
    looks = [await _look(session, T_map_cameras[i], size, config) for i in np.unique(at)]
    depth_m = np.concatenate([look.depth_m.ravel() for look in looks])
    return dataclasses.replace(views, depth_range_m=depth_range(depth_m))


@dataclass(frozen=True)
class _Walked:
    """Where a session's camera was, in the map as it is now."""

    t_ns: NDArray[np.int64]  # [F]
    T_map_cameras: NDArray[np.float64]  # [F, 4, 4], of frames with a pose
    T_map_keyframes: NDArray[np.float64]  # [K, 4, 4]


async def _walked(session: Session) -> _Walked:
    trajectory = await fetch_trajectory(session)
    has_pose = np.array([record.status in HAS_POSE for record in trajectory.records], bool)
    if not has_pose.any():
        raise NotFoundError(f"session {session.name} has no pose yet: stream frames first")
    seqs = np.array([record.seq for record in trajectory.records], np.int64)
    t_ns = np.array([record.t_ns for record in trajectory.records], np.int64)
    T_map_cameras = trajectory.T_world_cameras_final
    is_keyframe = has_pose & np.isin(seqs, trajectory.keyframe_seqs)
    T_keyframes = T_map_cameras[is_keyframe if is_keyframe.any() else has_pose]
    return _Walked(t_ns[has_pose], T_map_cameras[has_pose], T_keyframes)


async def _cameras(
    session: Session, request: PathRenderRequest, config: GatewayConfig
) -> NDArray[np.float64]:
    if request.path is PathKind.POSES:
        T_keys = [matrix_of(pose, f"poses[{i}]") for i, pose in enumerate(request.poses)]
        return await asyncio.to_thread(smooth_path, np.stack(T_keys), request.frames)
    walked = await _walked(session)
    if request.path is PathKind.TRAJECTORY:
        path = walked.t_ns, walked.T_map_cameras
        return await asyncio.to_thread(timed_path, *path, request.frames)
    T_keyframes = walked.T_map_keyframes
    if request.path is PathKind.ORBIT:
        return await _around(session, request, T_keyframes, config)
    at = np.linspace(0, len(T_keyframes) - 1, min(_TOUR_KEYFRAMES, len(T_keyframes)))
    return await asyncio.to_thread(smooth_path, T_keyframes[at.round().astype(int)], request.frames)


async def _around(
    session: Session,
    request: PathRenderRequest,
    T_keyframes: NDArray[np.float64],
    config: GatewayConfig,
) -> NDArray[np.float64]:
    T_first = matrix_of(request.poses[0], "poses[0]") if request.poses else _middle(T_keyframes)
    centre = _centre(request)
    if centre is None:
        centre = await _seen_ahead(session, T_first, config)
    turns = np.radians(request.turn_deg) * np.arange(request.frames) / request.frames
    return np.stack([orbit(T_first, centre, upward(T_keyframes), turn) for turn in turns])


async def _seen_ahead(
    session: Session, T_map_camera: NDArray[np.float64], config: GatewayConfig
) -> NDArray[np.float64]:
    """The point of the map in the middle of a view."""
    colour = session.calibration.colour.intrinsics
    depth_m = (await _look(session, T_map_camera, colour, config)).depth_m
    rows, columns = (slice(side // 3, side - side // 3) for side in depth_m.shape)
    ahead_m = depth_m[rows, columns]
    if not (ahead_m > 0).any():
        raise InputError("centre", "the first view shows nothing of the map to turn about")
    return T_map_camera[:3, 3] + float(np.median(ahead_m[ahead_m > 0])) * T_map_camera[:3, 2]


async def _look(
    session: Session, T_map_camera: NDArray[np.float64], size: Intrinsics, config: GatewayConfig
) -> RenderReply:
    """A small view."""
    small = size.scaled(min(1.0, _LOOK_PX / size.width))
    return await ask_render(session, RenderRequest(T_map_camera, small), config)


def _middle(T_map_cameras: NDArray[np.float64]) -> NDArray[np.float64]:
    """The camera that is nearest to the mean position."""
    positions = T_map_cameras[:, :3, 3]
    return T_map_cameras[np.linalg.norm(positions - positions.mean(axis=0), axis=1).argmin()]


def _centre(request: PathRenderRequest) -> NDArray[np.float64] | None:
    if request.centre is None:
        return None
    centre = np.array([request.centre.x, request.centre.y, request.centre.z])
    if not np.abs(centre).max() <= MAX_POSITION_M:
        raise InputError("centre", f"must be within {MAX_POSITION_M:.0f} m of the origin")
    return centre
