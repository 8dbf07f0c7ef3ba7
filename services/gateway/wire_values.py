"""Protobuf messages to our values and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.gateway.poses import TimedPose
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, TrackingStatus
from shared.localization import LocalizationStatus, LocalizeMessage, LocalizeReply
from shared.se3 import Pose, Quaternion, Vector3
from shared.stream import (
    DepthMessage,
    ErrorDetail,
    FrameMessage,
    FrameReply,
    PriorMessage,
)
from shared.wire import pose_service_pb2, tracking_service_pb2, types_pb2

_COLOUR = {
    tracking_service_pb2.COLOUR_ENCODING_JPEG: ColourEncoding.JPEG,
    tracking_service_pb2.COLOUR_ENCODING_PNG: ColourEncoding.PNG,
    tracking_service_pb2.COLOUR_ENCODING_RGB8: ColourEncoding.RGB8,
}
_DEPTH = {
    tracking_service_pb2.DEPTH_ENCODING_PNG16: DepthEncoding.PNG16,
    tracking_service_pb2.DEPTH_ENCODING_RAW16: DepthEncoding.RAW16,
    tracking_service_pb2.DEPTH_ENCODING_ZLIB16: DepthEncoding.ZLIB16,
}

_STATUSES: dict[TrackingStatus | None, types_pb2.TrackingStatus] = {
    None: types_pb2.TRACKING_STATUS_UNSPECIFIED,
    TrackingStatus.TRACKED: types_pb2.TRACKING_STATUS_TRACKED,
    TrackingStatus.COARSE_ONLY: types_pb2.TRACKING_STATUS_COARSE_ONLY,
    TrackingStatus.RELOCALISED: types_pb2.TRACKING_STATUS_RELOCALISED,
    TrackingStatus.LOST: types_pb2.TRACKING_STATUS_LOST,
    TrackingStatus.SUPERSEDED: types_pb2.TRACKING_STATUS_SUPERSEDED,
    TrackingStatus.NEED_FRAMES: types_pb2.TRACKING_STATUS_NEED_FRAMES,
}
_LOCALIZATIONS = {
    LocalizationStatus.LOCALISED: tracking_service_pb2.LOCALIZATION_STATUS_LOCALISED,
    LocalizationStatus.COLOUR_ONLY: tracking_service_pb2.LOCALIZATION_STATUS_COLOUR_ONLY,
    LocalizationStatus.NOT_LOCALISED: tracking_service_pb2.LOCALIZATION_STATUS_NOT_LOCALISED,
}


def require(message: Any, field: str, where: str = "") -> Any:
    """A sub-message that must be there.

    Raises:
        InputError: it is not.
    """
    if not message.HasField(field):
        raise InputError(f"{where}{field}", "is missing")
    return getattr(message, field)


def chosen(value: Any, known: Mapping[Any, Any], field: str) -> Any:
    """The value of an enumeration.

    Raises:
        InputError: unspecified or unknown.
    """
    if value not in known:
        raise InputError(field, f"must be one of {', '.join(map(str, known.values()))}")
    return known[value]


def pose_from(message: types_pb2.Pose) -> Pose:
    """A pose with named components."""
    p, q = message.position, message.orientation
    return Pose(Vector3(p.x, p.y, p.z), Quaternion(q.x, q.y, q.z, q.w))


def matrix_from(message: types_pb2.Pose, field: str) -> NDArray[np.float64]:
    """A pose as a 4x4 matrix.

    Raises:
        InputError: a component is not finite or the quaternion has no length; names the field.
    """
    try:
        return pose_from(message).matrix()
    except InputError as error:
        raise InputError(f"{field}.{error.field}", error.reason) from None


def pose_to(T: NDArray[np.float64]) -> types_pb2.Pose:
    """A 4x4 matrix as a pose message."""
    return _pose_message(Pose.from_matrix(T))


def _pose_message(pose: Pose) -> types_pb2.Pose:
    p, q = pose.position, pose.orientation
    return types_pb2.Pose(
        position=types_pb2.Vector3(x=p.x, y=p.y, z=p.z),
        orientation=types_pb2.Quaternion(x=q.x, y=q.y, z=q.z, w=q.w),
    )


def intrinsics_from(message: types_pb2.Intrinsics) -> Intrinsics:
    """A pinhole camera."""
    m = message
    return Intrinsics(m.fx, m.fy, m.cx, m.cy, m.width, m.height)


def _camera_from(message: types_pb2.Camera, where: str) -> Camera:
    intrinsics = intrinsics_from(require(message, "intrinsics", where))
    return Camera(intrinsics, tuple(message.distortion), message.fisheye)


def calibration_from(message: types_pb2.Calibration) -> Calibration:
    """An RGB-D device; its numbers are not checked here."""
    optional: dict[str, Any] = {}
    if message.HasField("depth"):
        optional["depth"] = _camera_from(message.depth, "calibration.depth.")
    if message.HasField("T_colour_depth"):
        where = "calibration.T_colour_depth"
        optional["T_colour_depth"] = matrix_from(message.T_colour_depth, where)
    if message.HasField("max_depth_m"):
        optional["max_depth_m"] = message.max_depth_m
    colour = _camera_from(require(message, "colour", "calibration."), "calibration.colour.")
    return Calibration(colour, message.depth_scale, **optional)


def frame_from(message: tracking_service_pb2.Frame) -> FrameMessage:
    """A frame; its images are not checked here."""
    prior = None
    if message.HasField("prior"):
        prior = PriorMessage(pose_from(require(message.prior, "T_odom_camera", "prior.")))
    return FrameMessage(
        seq=message.seq,
        t_ns=message.t_ns,
        rgb=_colour_from(message.rgb),
        depth=_depth_from(message.depth),
        prior=prior,
        flags=tuple(message.flags),
    )


def _colour_from(message: tracking_service_pb2.ColourImage) -> ColourImage:
    return ColourImage(chosen(message.encoding, _COLOUR, "rgb.encoding"), message.bytes)


def _depth_from(message: tracking_service_pb2.DepthImage) -> DepthMessage:
    return DepthMessage(
        chosen(message.encoding, _DEPTH, "depth.encoding"),
        message.bytes,
        message.scale if message.HasField("scale") else None,
    )


def localize_from(message: tracking_service_pb2.LocalizeRequest) -> LocalizeMessage:
    """A single image; it is not checked here."""
    optional: dict[str, Any] = {}
    if message.HasField("depth"):
        optional["depth"] = _depth_from(message.depth)
    if message.HasField("T_map_camera_prior"):
        optional["T_map_camera_prior"] = pose_from(message.T_map_camera_prior)
    if message.HasField("calibration"):
        optional["calibration"] = calibration_from(message.calibration)
    if message.HasField("camera"):
        optional["camera"] = _camera_from(message.camera, "camera.")
    return LocalizeMessage(_colour_from(require(message, "rgb")), **optional)


def localized_to(reply: LocalizeReply) -> tracking_service_pb2.LocalizeResponse:
    """The answer to a single image."""
    pose = reply.T_map_camera
    return tracking_service_pb2.LocalizeResponse(
        status=_LOCALIZATIONS[reply.status],
        reason=reply.reason,
        T_map_camera=_pose_message(pose) if pose else None,
        pos_std_m=reply.pos_std_m,
        rot_std_deg=reply.rot_std_deg,
        covariance=reply.covariance,
        inliers=reply.inliers,
        inlier_share=reply.inlier_share,
        reference_seq=reply.reference_seq,
        map_revision=reply.map_revision,
        timings_ms=reply.timings_ms,
    )


def reply_to(reply: FrameReply) -> tracking_service_pb2.TrackFramesResponse:
    """A frame's reply."""
    pose = reply.T_map_camera
    return tracking_service_pb2.TrackFramesResponse(
        seq=reply.seq,
        t_ns=reply.t_ns,
        status=_STATUSES[reply.status],
        T_map_camera=_pose_message(pose) if pose else None,
        pos_std_m=reply.pos_std_m,
        rot_std_deg=reply.rot_std_deg,
        inliers=reply.inliers,
        inlier_share=reply.inlier_share,
        reference_seq=reply.reference_seq,
        map_revision=reply.map_revision,
        keyframe=reply.keyframe,
        timings_ms=reply.timings_ms,
        credit=reply.credit,
        error=_detail_message(reply.error),
        map_problem=_detail_message(reply.map_problem),
    )


def _detail_message(detail: ErrorDetail | None) -> types_pb2.ErrorDetail | None:
    if detail is None:
        return None
    return types_pb2.ErrorDetail(code=detail.code, field=detail.field, reason=detail.reason)


def timed_pose_to(
    pose: TimedPose, T_map_odom: NDArray[np.float64] | None = None
) -> pose_service_pb2.TimedPose:
    """A pose at a time, with the correction of the device's odometry where it is known."""
    deviation = pose.deviations()
    return pose_service_pb2.TimedPose(
        seq=pose.seq,
        t_ns=pose.t_ns,
        status=_STATUSES[pose.status],
        T_map_camera=pose_to(pose.T_map_camera),
        pos_std_m=deviation[0] if deviation else None,
        rot_std_deg=deviation[1] if deviation else None,
        reference_seq=pose.reference_seq,
        map_revision=pose.map_revision,
        is_interpolated=pose.is_interpolated,
        T_map_odom=None if T_map_odom is None else pose_to(T_map_odom),
    )
