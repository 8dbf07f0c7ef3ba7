from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class SessionMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SESSION_MODE_UNSPECIFIED: _ClassVar[SessionMode]
    SESSION_MODE_LIVE: _ClassVar[SessionMode]
    SESSION_MODE_OFFLINE: _ClassVar[SessionMode]

class TrackingStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRACKING_STATUS_UNSPECIFIED: _ClassVar[TrackingStatus]
    TRACKING_STATUS_TRACKED: _ClassVar[TrackingStatus]
    TRACKING_STATUS_COARSE_ONLY: _ClassVar[TrackingStatus]
    TRACKING_STATUS_RELOCALISED: _ClassVar[TrackingStatus]
    TRACKING_STATUS_LOST: _ClassVar[TrackingStatus]
    TRACKING_STATUS_SUPERSEDED: _ClassVar[TrackingStatus]
    TRACKING_STATUS_NEED_FRAMES: _ClassVar[TrackingStatus]
SESSION_MODE_UNSPECIFIED: SessionMode
SESSION_MODE_LIVE: SessionMode
SESSION_MODE_OFFLINE: SessionMode
TRACKING_STATUS_UNSPECIFIED: TrackingStatus
TRACKING_STATUS_TRACKED: TrackingStatus
TRACKING_STATUS_COARSE_ONLY: TrackingStatus
TRACKING_STATUS_RELOCALISED: TrackingStatus
TRACKING_STATUS_LOST: TrackingStatus
TRACKING_STATUS_SUPERSEDED: TrackingStatus
TRACKING_STATUS_NEED_FRAMES: TrackingStatus

class Vector3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("x", "y", "z", "w")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    W_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    w: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., w: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("position", "orientation")
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ORIENTATION_FIELD_NUMBER: _ClassVar[int]
    position: Vector3
    orientation: Quaternion
    def __init__(self, position: _Optional[_Union[Vector3, _Mapping]] = ..., orientation: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class Intrinsics(_message.Message):
    __slots__ = ("fx", "fy", "cx", "cy", "width", "height")
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    def __init__(self, fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ..., width: _Optional[int] = ..., height: _Optional[int] = ...) -> None: ...

class Camera(_message.Message):
    __slots__ = ("intrinsics", "distortion", "fisheye")
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_FIELD_NUMBER: _ClassVar[int]
    FISHEYE_FIELD_NUMBER: _ClassVar[int]
    intrinsics: Intrinsics
    distortion: _containers.RepeatedScalarFieldContainer[float]
    fisheye: bool
    def __init__(self, intrinsics: _Optional[_Union[Intrinsics, _Mapping]] = ..., distortion: _Optional[_Iterable[float]] = ..., fisheye: _Optional[bool] = ...) -> None: ...

class Calibration(_message.Message):
    __slots__ = ("colour", "depth_scale", "depth", "T_colour_depth", "max_depth_m")
    COLOUR_FIELD_NUMBER: _ClassVar[int]
    DEPTH_SCALE_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    T_COLOUR_DEPTH_FIELD_NUMBER: _ClassVar[int]
    MAX_DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    colour: Camera
    depth_scale: float
    depth: Camera
    T_colour_depth: Pose
    max_depth_m: float
    def __init__(self, colour: _Optional[_Union[Camera, _Mapping]] = ..., depth_scale: _Optional[float] = ..., depth: _Optional[_Union[Camera, _Mapping]] = ..., T_colour_depth: _Optional[_Union[Pose, _Mapping]] = ..., max_depth_m: _Optional[float] = ...) -> None: ...

class ErrorDetail(_message.Message):
    __slots__ = ("code", "field", "reason")
    CODE_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    code: str
    field: str
    reason: str
    def __init__(self, code: _Optional[str] = ..., field: _Optional[str] = ..., reason: _Optional[str] = ...) -> None: ...
