from shared.wire import types_pb2 as _types_pb2
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ViewContent(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    VIEW_CONTENT_UNSPECIFIED: _ClassVar[ViewContent]
    VIEW_CONTENT_COLOUR: _ClassVar[ViewContent]
    VIEW_CONTENT_DEPTH: _ClassVar[ViewContent]
    VIEW_CONTENT_ALPHA: _ClassVar[ViewContent]
    VIEW_CONTENT_CONFIDENCE: _ClassVar[ViewContent]

class ImageFormat(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    IMAGE_FORMAT_UNSPECIFIED: _ClassVar[ImageFormat]
    IMAGE_FORMAT_JPEG: _ClassVar[ImageFormat]
    IMAGE_FORMAT_PNG: _ClassVar[ImageFormat]

class MapFormat(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MAP_FORMAT_UNSPECIFIED: _ClassVar[MapFormat]
    MAP_FORMAT_PLY: _ClassVar[MapFormat]
    MAP_FORMAT_MESH: _ClassVar[MapFormat]
    MAP_FORMAT_SNAPSHOT: _ClassVar[MapFormat]
    MAP_FORMAT_SPZ: _ClassVar[MapFormat]
    MAP_FORMAT_GLB: _ClassVar[MapFormat]
    MAP_FORMAT_MESH_GLB: _ClassVar[MapFormat]
    MAP_FORMAT_POINTS: _ClassVar[MapFormat]
VIEW_CONTENT_UNSPECIFIED: ViewContent
VIEW_CONTENT_COLOUR: ViewContent
VIEW_CONTENT_DEPTH: ViewContent
VIEW_CONTENT_ALPHA: ViewContent
VIEW_CONTENT_CONFIDENCE: ViewContent
IMAGE_FORMAT_UNSPECIFIED: ImageFormat
IMAGE_FORMAT_JPEG: ImageFormat
IMAGE_FORMAT_PNG: ImageFormat
MAP_FORMAT_UNSPECIFIED: MapFormat
MAP_FORMAT_PLY: MapFormat
MAP_FORMAT_MESH: MapFormat
MAP_FORMAT_SNAPSHOT: MapFormat
MAP_FORMAT_SPZ: MapFormat
MAP_FORMAT_GLB: MapFormat
MAP_FORMAT_MESH_GLB: MapFormat
MAP_FORMAT_POINTS: MapFormat

class GetMapInfoRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class GetMapInfoResponse(_message.Message):
    __slots__ = ("session_id", "mapper", "epoch", "map_revision", "frames", "keyframes", "landmarks", "primary_anchors", "secondary_anchors", "iterations", "pending", "psnr_db", "map_bytes", "device", "loops")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    MAPPER_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    MAP_REVISION_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    KEYFRAMES_FIELD_NUMBER: _ClassVar[int]
    LANDMARKS_FIELD_NUMBER: _ClassVar[int]
    PRIMARY_ANCHORS_FIELD_NUMBER: _ClassVar[int]
    SECONDARY_ANCHORS_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    PENDING_FIELD_NUMBER: _ClassVar[int]
    PSNR_DB_FIELD_NUMBER: _ClassVar[int]
    MAP_BYTES_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    LOOPS_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    mapper: str
    epoch: int
    map_revision: int
    frames: int
    keyframes: int
    landmarks: int
    primary_anchors: int
    secondary_anchors: int
    iterations: int
    pending: int
    psnr_db: float
    map_bytes: int
    device: str
    loops: int
    def __init__(self, session_id: _Optional[str] = ..., mapper: _Optional[str] = ..., epoch: _Optional[int] = ..., map_revision: _Optional[int] = ..., frames: _Optional[int] = ..., keyframes: _Optional[int] = ..., landmarks: _Optional[int] = ..., primary_anchors: _Optional[int] = ..., secondary_anchors: _Optional[int] = ..., iterations: _Optional[int] = ..., pending: _Optional[int] = ..., psnr_db: _Optional[float] = ..., map_bytes: _Optional[int] = ..., device: _Optional[str] = ..., loops: _Optional[int] = ...) -> None: ...

class RenderViewRequest(_message.Message):
    __slots__ = ("session_id", "T_map_camera", "intrinsics", "appearance_t_ns", "content", "format")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    T_MAP_CAMERA_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    APPEARANCE_T_NS_FIELD_NUMBER: _ClassVar[int]
    CONTENT_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    T_map_camera: _types_pb2.Pose
    intrinsics: _types_pb2.Intrinsics
    appearance_t_ns: int
    content: ViewContent
    format: ImageFormat
    def __init__(self, session_id: _Optional[str] = ..., T_map_camera: _Optional[_Union[_types_pb2.Pose, _Mapping]] = ..., intrinsics: _Optional[_Union[_types_pb2.Intrinsics, _Mapping]] = ..., appearance_t_ns: _Optional[int] = ..., content: _Optional[_Union[ViewContent, str]] = ..., format: _Optional[_Union[ImageFormat, str]] = ...) -> None: ...

class RenderViewResponse(_message.Message):
    __slots__ = ("map_revision", "format", "image", "confidence", "state")
    MAP_REVISION_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    map_revision: int
    format: ImageFormat
    image: bytes
    confidence: float
    state: str
    def __init__(self, map_revision: _Optional[int] = ..., format: _Optional[_Union[ImageFormat, str]] = ..., image: _Optional[bytes] = ..., confidence: _Optional[float] = ..., state: _Optional[str] = ...) -> None: ...

class ExportMapRequest(_message.Message):
    __slots__ = ("session_id", "format")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    format: MapFormat
    def __init__(self, session_id: _Optional[str] = ..., format: _Optional[_Union[MapFormat, str]] = ...) -> None: ...

class ExportMapResponse(_message.Message):
    __slots__ = ("offset", "total", "bytes")
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    offset: int
    total: int
    bytes: bytes
    def __init__(self, offset: _Optional[int] = ..., total: _Optional[int] = ..., bytes: _Optional[bytes] = ...) -> None: ...
