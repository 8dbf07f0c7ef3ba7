from shared.wire import types_pb2 as _types_pb2
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class TimedPose(_message.Message):
    __slots__ = ("seq", "t_ns", "status", "T_map_camera", "pos_std_m", "rot_std_deg", "reference_seq", "map_revision", "is_interpolated", "T_map_odom")
    SEQ_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    T_MAP_CAMERA_FIELD_NUMBER: _ClassVar[int]
    POS_STD_M_FIELD_NUMBER: _ClassVar[int]
    ROT_STD_DEG_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_SEQ_FIELD_NUMBER: _ClassVar[int]
    MAP_REVISION_FIELD_NUMBER: _ClassVar[int]
    IS_INTERPOLATED_FIELD_NUMBER: _ClassVar[int]
    T_MAP_ODOM_FIELD_NUMBER: _ClassVar[int]
    seq: int
    t_ns: int
    status: _types_pb2.TrackingStatus
    T_map_camera: _types_pb2.Pose
    pos_std_m: float
    rot_std_deg: float
    reference_seq: int
    map_revision: int
    is_interpolated: bool
    T_map_odom: _types_pb2.Pose
    def __init__(self, seq: _Optional[int] = ..., t_ns: _Optional[int] = ..., status: _Optional[_Union[_types_pb2.TrackingStatus, str]] = ..., T_map_camera: _Optional[_Union[_types_pb2.Pose, _Mapping]] = ..., pos_std_m: _Optional[float] = ..., rot_std_deg: _Optional[float] = ..., reference_seq: _Optional[int] = ..., map_revision: _Optional[int] = ..., is_interpolated: _Optional[bool] = ..., T_map_odom: _Optional[_Union[_types_pb2.Pose, _Mapping]] = ...) -> None: ...

class GetPoseRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class GetPoseResponse(_message.Message):
    __slots__ = ("pose",)
    POSE_FIELD_NUMBER: _ClassVar[int]
    pose: TimedPose
    def __init__(self, pose: _Optional[_Union[TimedPose, _Mapping]] = ...) -> None: ...

class GetPoseAtRequest(_message.Message):
    __slots__ = ("session_id", "t_ns")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    t_ns: int
    def __init__(self, session_id: _Optional[str] = ..., t_ns: _Optional[int] = ...) -> None: ...

class GetPoseAtResponse(_message.Message):
    __slots__ = ("pose",)
    POSE_FIELD_NUMBER: _ClassVar[int]
    pose: TimedPose
    def __init__(self, pose: _Optional[_Union[TimedPose, _Mapping]] = ...) -> None: ...

class WatchPosesRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class WatchPosesResponse(_message.Message):
    __slots__ = ("pose", "is_correction")
    POSE_FIELD_NUMBER: _ClassVar[int]
    IS_CORRECTION_FIELD_NUMBER: _ClassVar[int]
    pose: TimedPose
    is_correction: bool
    def __init__(self, pose: _Optional[_Union[TimedPose, _Mapping]] = ..., is_correction: _Optional[bool] = ...) -> None: ...
