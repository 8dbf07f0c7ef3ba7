from shared.wire import types_pb2 as _types_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ColourEncoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    COLOUR_ENCODING_UNSPECIFIED: _ClassVar[ColourEncoding]
    COLOUR_ENCODING_JPEG: _ClassVar[ColourEncoding]
    COLOUR_ENCODING_PNG: _ClassVar[ColourEncoding]
    COLOUR_ENCODING_RGB8: _ClassVar[ColourEncoding]

class DepthEncoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DEPTH_ENCODING_UNSPECIFIED: _ClassVar[DepthEncoding]
    DEPTH_ENCODING_PNG16: _ClassVar[DepthEncoding]
    DEPTH_ENCODING_RAW16: _ClassVar[DepthEncoding]
    DEPTH_ENCODING_ZLIB16: _ClassVar[DepthEncoding]

class LocalizationStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LOCALIZATION_STATUS_UNSPECIFIED: _ClassVar[LocalizationStatus]
    LOCALIZATION_STATUS_LOCALISED: _ClassVar[LocalizationStatus]
    LOCALIZATION_STATUS_COLOUR_ONLY: _ClassVar[LocalizationStatus]
    LOCALIZATION_STATUS_NOT_LOCALISED: _ClassVar[LocalizationStatus]
COLOUR_ENCODING_UNSPECIFIED: ColourEncoding
COLOUR_ENCODING_JPEG: ColourEncoding
COLOUR_ENCODING_PNG: ColourEncoding
COLOUR_ENCODING_RGB8: ColourEncoding
DEPTH_ENCODING_UNSPECIFIED: DepthEncoding
DEPTH_ENCODING_PNG16: DepthEncoding
DEPTH_ENCODING_RAW16: DepthEncoding
DEPTH_ENCODING_ZLIB16: DepthEncoding
LOCALIZATION_STATUS_UNSPECIFIED: LocalizationStatus
LOCALIZATION_STATUS_LOCALISED: LocalizationStatus
LOCALIZATION_STATUS_COLOUR_ONLY: LocalizationStatus
LOCALIZATION_STATUS_NOT_LOCALISED: LocalizationStatus

class ColourImage(_message.Message):
    __slots__ = ("encoding", "bytes")
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    encoding: ColourEncoding
    bytes: bytes
    def __init__(self, encoding: _Optional[_Union[ColourEncoding, str]] = ..., bytes: _Optional[bytes] = ...) -> None: ...

class DepthImage(_message.Message):
    __slots__ = ("encoding", "bytes", "scale")
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    encoding: DepthEncoding
    bytes: bytes
    scale: float
    def __init__(self, encoding: _Optional[_Union[DepthEncoding, str]] = ..., bytes: _Optional[bytes] = ..., scale: _Optional[float] = ...) -> None: ...

class OdometryPrior(_message.Message):
    __slots__ = ("T_odom_camera",)
    T_ODOM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    T_odom_camera: _types_pb2.Pose
    def __init__(self, T_odom_camera: _Optional[_Union[_types_pb2.Pose, _Mapping]] = ...) -> None: ...

class Frame(_message.Message):
    __slots__ = ("seq", "t_ns", "rgb", "depth", "prior", "flags")
    SEQ_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    RGB_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    PRIOR_FIELD_NUMBER: _ClassVar[int]
    FLAGS_FIELD_NUMBER: _ClassVar[int]
    seq: int
    t_ns: int
    rgb: ColourImage
    depth: DepthImage
    prior: OdometryPrior
    flags: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, seq: _Optional[int] = ..., t_ns: _Optional[int] = ..., rgb: _Optional[_Union[ColourImage, _Mapping]] = ..., depth: _Optional[_Union[DepthImage, _Mapping]] = ..., prior: _Optional[_Union[OdometryPrior, _Mapping]] = ..., flags: _Optional[_Iterable[str]] = ...) -> None: ...

class TrackFramesRequest(_message.Message):
    __slots__ = ("session_id", "frame")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    frame: Frame
    def __init__(self, session_id: _Optional[str] = ..., frame: _Optional[_Union[Frame, _Mapping]] = ...) -> None: ...

class TrackFramesResponse(_message.Message):
    __slots__ = ("seq", "t_ns", "status", "T_map_camera", "pos_std_m", "rot_std_deg", "inliers", "inlier_share", "reference_seq", "map_revision", "keyframe", "timings_ms", "credit", "error", "map_problem")
    class TimingsMsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    SEQ_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    T_MAP_CAMERA_FIELD_NUMBER: _ClassVar[int]
    POS_STD_M_FIELD_NUMBER: _ClassVar[int]
    ROT_STD_DEG_FIELD_NUMBER: _ClassVar[int]
    INLIERS_FIELD_NUMBER: _ClassVar[int]
    INLIER_SHARE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_SEQ_FIELD_NUMBER: _ClassVar[int]
    MAP_REVISION_FIELD_NUMBER: _ClassVar[int]
    KEYFRAME_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_MS_FIELD_NUMBER: _ClassVar[int]
    CREDIT_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    MAP_PROBLEM_FIELD_NUMBER: _ClassVar[int]
    seq: int
    t_ns: int
    status: _types_pb2.TrackingStatus
    T_map_camera: _types_pb2.Pose
    pos_std_m: float
    rot_std_deg: float
    inliers: int
    inlier_share: float
    reference_seq: int
    map_revision: int
    keyframe: bool
    timings_ms: _containers.ScalarMap[str, float]
    credit: int
    error: _types_pb2.ErrorDetail
    map_problem: _types_pb2.ErrorDetail
    def __init__(self, seq: _Optional[int] = ..., t_ns: _Optional[int] = ..., status: _Optional[_Union[_types_pb2.TrackingStatus, str]] = ..., T_map_camera: _Optional[_Union[_types_pb2.Pose, _Mapping]] = ..., pos_std_m: _Optional[float] = ..., rot_std_deg: _Optional[float] = ..., inliers: _Optional[int] = ..., inlier_share: _Optional[float] = ..., reference_seq: _Optional[int] = ..., map_revision: _Optional[int] = ..., keyframe: _Optional[bool] = ..., timings_ms: _Optional[_Mapping[str, float]] = ..., credit: _Optional[int] = ..., error: _Optional[_Union[_types_pb2.ErrorDetail, _Mapping]] = ..., map_problem: _Optional[_Union[_types_pb2.ErrorDetail, _Mapping]] = ...) -> None: ...

class WatchFramesRequest(_message.Message):
    __slots__ = ("session_id", "frame", "calibration")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    frame: Frame
    calibration: _types_pb2.Calibration
    def __init__(self, session_id: _Optional[str] = ..., frame: _Optional[_Union[Frame, _Mapping]] = ..., calibration: _Optional[_Union[_types_pb2.Calibration, _Mapping]] = ...) -> None: ...

class WatchFramesResponse(_message.Message):
    __slots__ = ("reply",)
    REPLY_FIELD_NUMBER: _ClassVar[int]
    reply: TrackFramesResponse
    def __init__(self, reply: _Optional[_Union[TrackFramesResponse, _Mapping]] = ...) -> None: ...

class LocalizeRequest(_message.Message):
    __slots__ = ("session_id", "rgb", "depth", "T_map_camera_prior", "calibration", "camera")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    RGB_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    T_MAP_CAMERA_PRIOR_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    rgb: ColourImage
    depth: DepthImage
    T_map_camera_prior: _types_pb2.Pose
    calibration: _types_pb2.Calibration
    camera: _types_pb2.Camera
    def __init__(self, session_id: _Optional[str] = ..., rgb: _Optional[_Union[ColourImage, _Mapping]] = ..., depth: _Optional[_Union[DepthImage, _Mapping]] = ..., T_map_camera_prior: _Optional[_Union[_types_pb2.Pose, _Mapping]] = ..., calibration: _Optional[_Union[_types_pb2.Calibration, _Mapping]] = ..., camera: _Optional[_Union[_types_pb2.Camera, _Mapping]] = ...) -> None: ...

class LocalizeResponse(_message.Message):
    __slots__ = ("status", "reason", "T_map_camera", "pos_std_m", "rot_std_deg", "covariance", "inliers", "inlier_share", "reference_seq", "map_revision", "timings_ms")
    class TimingsMsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    STATUS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    T_MAP_CAMERA_FIELD_NUMBER: _ClassVar[int]
    POS_STD_M_FIELD_NUMBER: _ClassVar[int]
    ROT_STD_DEG_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    INLIERS_FIELD_NUMBER: _ClassVar[int]
    INLIER_SHARE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_SEQ_FIELD_NUMBER: _ClassVar[int]
    MAP_REVISION_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_MS_FIELD_NUMBER: _ClassVar[int]
    status: LocalizationStatus
    reason: str
    T_map_camera: _types_pb2.Pose
    pos_std_m: float
    rot_std_deg: float
    covariance: _containers.RepeatedScalarFieldContainer[float]
    inliers: int
    inlier_share: float
    reference_seq: int
    map_revision: int
    timings_ms: _containers.ScalarMap[str, float]
    def __init__(self, status: _Optional[_Union[LocalizationStatus, str]] = ..., reason: _Optional[str] = ..., T_map_camera: _Optional[_Union[_types_pb2.Pose, _Mapping]] = ..., pos_std_m: _Optional[float] = ..., rot_std_deg: _Optional[float] = ..., covariance: _Optional[_Iterable[float]] = ..., inliers: _Optional[int] = ..., inlier_share: _Optional[float] = ..., reference_seq: _Optional[int] = ..., map_revision: _Optional[int] = ..., timings_ms: _Optional[_Mapping[str, float]] = ...) -> None: ...
