"""Every HTTP call to the gateway as a value: what to send, and how to read the answer.

The synchronous and the asynchronous client differ only in who sends it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar
from urllib.parse import quote

import httpx
import numpy as np
from numpy.typing import NDArray

from shared import codec
from shared.camera import Calibration, Intrinsics
from shared.errors import (
    ClaimLostError,
    ConfigError,
    ConflictError,
    ForbiddenError,
    InputError,
    NotFoundError,
    PointSlamError,
    RateLimitedError,
    StorageError,
    UnauthenticatedError,
    UnavailableError,
)
from shared.frames import HAS_POSE, TrackingStatus
from shared.localization import LocalizeMessage, LocalizeReply
from shared.maps import RenderReply
from shared.se3 import Pose
from shared.stream import ErrorDetail, FrameMessage, FrameReply

T = TypeVar("T")

_KINDS: dict[str, type[PointSlamError]] = {
    kind.code: kind
    for kind in (
        ClaimLostError,
        ConfigError,
        ConflictError,
        ForbiddenError,
        NotFoundError,
        RateLimitedError,
        StorageError,
        UnauthenticatedError,
        UnavailableError,
    )
}
_KEY_VARIABLE = "POINTSLAM_API_KEY"
_INPUT_CODES = (InputError.code, "too_large")
SLOW_S = 300.0  # saving, exporting


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request and how its successful answer is read."""

    method: str
    path: str
    read: Callable[[httpx.Response], T]
    params: dict[str, Any] = field(default_factory=dict)
    json: Any = None
    content: bytes | None = None
    headers: dict[str, str] = field(default_factory=dict)
    timeout_s: float = 120.0

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of httpx."""
        return {
            "params": self.params,
            "json": self.json,
            "content": self.content,
            "headers": self.headers,
            "timeout": self.timeout_s,
        }

    def answer(self, response: httpx.Response) -> T:
        """The value in a response.

        Raises:
            PointSlamError: the gateway refused; the class that it raised there.
        """
        if response.is_success:
            return self.read(response)
        raise error_from(problem_of(response))


def problem_of(response: httpx.Response) -> ErrorDetail:
    """What a problem document says; any other body as it is."""
    try:
        problem = response.json()
        return ErrorDetail(problem["code"], problem.get("field", ""), problem["reason"])
    except (ValueError, KeyError, TypeError):
        code = UnavailableError.code if response.status_code in (502, 503, 504) else "error"
        return ErrorDetail(code, "", f"HTTP {response.status_code}: {response.text[:200]}")


def error_from(detail: ErrorDetail) -> PointSlamError:
    """The error that the gateway raised, as a class of ours."""
    if detail.code in _INPUT_CODES:
        return InputError(detail.field, detail.reason)
    text = f"{detail.field}: {detail.reason}" if detail.field else detail.reason
    return _KINDS.get(detail.code, PointSlamError)(text)


def key_headers(api_key: str | None) -> dict[str, str]:
    """What every request carries: the key that was given, or that of the environment, if any."""
    key = api_key or os.environ.get(_KEY_VARIABLE)
    return {"Authorization": f"Bearer {key}"} if key else {}


def path_of(session: str, rest: str = "") -> str:
    return f"/v1/sessions/{quote(session, safe='')}{rest}"


def _json(response: httpx.Response) -> Any:
    return response.json()


def _nothing(_: httpx.Response) -> None:
    return None


def ready() -> Call[bool]:
    """Whether sessions can be created and tracked (not ready is an UnavailableError)."""
    return Call("GET", "/readyz", lambda _: True, timeout_s=5.0)


def list_sessions() -> Call[list[dict[str, Any]]]:
    """All sessions."""
    return Call("GET", "/v1/sessions", lambda response: response.json()["sessions"])


@dataclass(frozen=True)
class NewSession:
    """How a session shall be created."""

    calibration: Calibration
    name: str | None = None
    mode: str = "live"
    seed: int = 0
    T_map_first: NDArray[np.float64] | None = None


def create_session(new: NewSession) -> Call[dict[str, Any]]:
    """A new session; answers its state."""
    T_first = None if new.T_map_first is None else Pose.from_matrix(new.T_map_first)
    body = codec.to_json(new) | {"T_map_first": codec.to_json(T_first)}
    return Call("POST", "/v1/sessions", _json, json=body)


def info(session: str) -> Call[dict[str, Any]]:
    """State of a session."""
    return Call("GET", path_of(session), _json)


def delete(session: str) -> Call[None]:
    """Remove a session."""
    return Call("DELETE", path_of(session), _nothing)


def track(session: str, message: FrameMessage) -> Call[FrameReply]:
    """Track one frame."""
    return Call(
        "POST",
        path_of(session, "/frames"),
        lambda response: codec.unpack(FrameReply, response.content),
        content=codec.pack(message),
        headers={"Content-Type": "application/msgpack"},
    )


def localize(session: str, message: LocalizeMessage) -> Call[LocalizeReply]:
    """Find one image in the session's map."""
    return Call(
        "POST",
        path_of(session, "/localize"),
        lambda response: codec.unpack(LocalizeReply, response.content),
        content=codec.pack(message),
        headers={"Content-Type": "application/msgpack"},
    )


def pose(session: str, t_ns: int | None) -> Call[NDArray[np.float64]]:
    """T_map_camera, [4, 4], newest or at a time."""
    params = {} if t_ns is None else {"t_ns": t_ns}

    def read(response: httpx.Response) -> NDArray[np.float64]:
        return codec.from_plain(Pose, response.json()["T_map_camera"]).matrix()

    return Call("GET", path_of(session, "/pose"), read, params)


@dataclass(frozen=True)
class TrajectoryRecord:
    """One answered frame: the pose as it was told, and in the map as it is now."""

    seq: int
    t_ns: int
    status: TrackingStatus
    keyframe: bool
    reference_seq: int
    T_map_camera_online: NDArray[np.float64]  # [4, 4]
    T_map_camera_final: NDArray[np.float64]  # [4, 4]


def trajectory(session: str) -> Call[list[TrajectoryRecord]]:
    """Every answered frame."""

    def read(response: httpx.Response) -> list[TrajectoryRecord]:
        return [_record(plain) for plain in response.json()["records"]]

    return Call("GET", path_of(session, "/trajectory"), read)


def poses_of(records: list[TrajectoryRecord], kind: str) -> list[tuple[int, NDArray[np.float64]]]:
    """(t_ns, T_map_camera) of the frames that have a pose; `kind` is online or final."""
    if kind not in ("online", "final"):
        raise InputError("kind", f"must be online or final, got {kind!r}")
    return [
        (r.t_ns, r.T_map_camera_final if kind == "final" else r.T_map_camera_online)
        for r in records
        if r.status in HAS_POSE
    ]


def _record(plain: dict[str, Any]) -> TrajectoryRecord:
    return TrajectoryRecord(
        seq=plain["seq"],
        t_ns=plain["t_ns"],
        status=TrackingStatus(plain["status"]),
        keyframe=plain["keyframe"],
        reference_seq=plain["reference_seq"],
        T_map_camera_online=codec.from_plain(Pose, plain["T_map_camera_online"]).matrix(),
        T_map_camera_final=codec.from_plain(Pose, plain["T_map_camera_final"]).matrix(),
    )


def render(
    session: str,
    T_map_camera: NDArray[np.float64],
    intrinsics: Intrinsics | None,
    appearance_t_ns: int | None,
) -> Call[RenderReply]:
    """A view of the map: colour, depth and opacity."""
    view = Pose.from_matrix(T_map_camera)
    p, q = view.position, view.orientation
    params: dict[str, Any] = {"px": p.x, "py": p.y, "pz": p.z}
    params |= {"qx": q.x, "qy": q.y, "qz": q.z, "qw": q.w, "format": "msgpack"}
    params |= codec.to_json(intrinsics) if intrinsics is not None else {}
    params |= {} if appearance_t_ns is None else {"appearance_t_ns": appearance_t_ns}
    return Call(
        "GET",
        path_of(session, "/render"),
        lambda response: codec.unpack(RenderReply, response.content),
        params,
    )


def save(session: str) -> Call[dict[str, Any]]:
    """Write a snapshot."""
    return Call("POST", path_of(session, "/save"), _json, timeout_s=SLOW_S)


def export_path(session: str) -> str:
    """Where the map is fetched as a file."""
    return path_of(session, "/map")


def stream_url(url: str, session: str) -> str:
    """The WebSocket of a session's frames."""
    return _socket_url(url, session, "/stream")


def watch_url(url: str, session: str) -> str:
    """The WebSocket of the frames of one who watches a session."""
    return _socket_url(url, session, "/watch")


def device_text(device: Calibration | None) -> str | None:
    """What a watcher says before its frames; nothing where it has the session's device."""
    return None if device is None else json.dumps({"calibration": codec.to_json(device)})


def _socket_url(url: str, session: str, rest: str) -> str:
    return "ws" + url.removeprefix("http").rstrip("/") + path_of(session, rest)
