"""A source as a session of a running gateway, and a video in a map that exists."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pointslam.bridges.source import CameraFrame, Source
from pointslam.client import Client, Session
from pointslam.datasets.base import SequenceFrame
from pointslam.datasets.video import Video
from pointslam.recording import Recorder
from shared.camera import Camera, Intrinsics
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage
from shared.images import encode_depth, encode_jpeg
from shared.localization import LocalizeReply
from shared.se3 import Pose
from shared.stream import FrameMessage, FrameReply

Say = Callable[[str], None]
_SAY_EVERY_S = 1.0


@dataclass(frozen=True)
class StreamRequest:
    """Where a source goes. A session of that name is gone on with; without one a new one is made.

    `record`: an MCAP file that gets every frame that is sent. `watches`: the session is only
    watched: its map does not change.
    """

    gateway: str
    session: str | None = None
    record: Path | None = None
    watches: bool = False


def stream_source(source: Source, request: StreamRequest, say: Say) -> str:
    """Stream a source until it ends, live: the newest frame wins. Returns the session's name.

    Says the status once a second and every refusal. The map is saved at the end, also when the
    caller is interrupted.

    Raises:
        PointSlamError: the gateway refused the session or a frame, or the connection broke.
    """
    with Client(request.gateway) as client:
        session = _session(client, source, request)
        say(f"session {session.name} at {request.gateway}")
        frames = _messages(session, source, request.record)
        try:
            if request.watches:
                _say_replies(session.watch(frames, source.calibration), say)
            else:
                _say_replies(session.stream(frames), say)
        finally:
            source.close()
            if not request.watches:
                session.save()
    return session.name


def _say_replies(replies: Iterator[FrameReply], say: Say) -> None:
    next_s = 0.0
    for reply in replies:
        if reply.error is not None or time.monotonic() >= next_s:
            say(_line(reply))
            next_s = time.monotonic() + _SAY_EVERY_S


def localize_video(
    path: Path, intrinsics: Intrinsics | None, request: StreamRequest, say: Say
) -> list[LocalizeReply]:
    """Find every frame of a colour video in the map of a session, without depth.

    Args:
        intrinsics: the video's camera; without them the session's, scaled to the video's size.

    Raises:
        PointSlamError: there is no such session, or the video cannot be read.
    """
    video = Video(path)
    replies = []
    with Client(request.gateway) as client:
        session = client.session(request.session or "")
        for number in range(len(video)):
            rgb = video.frame(number)
            camera = None if intrinsics is None else Camera(intrinsics)
            reply = session.localize(encode_jpeg(rgb), device=camera)
            say(f"{number}: {reply.status}{_place(reply)}")
            replies.append(reply)
    return replies


def _session(client: Client, source: Source, request: StreamRequest) -> Session:
    name = request.session
    if request.watches:
        return client.session(name or "")
    exists = name is not None and name in {found["session"] for found in client.sessions()}
    if exists and name is not None:
        return client.session(name)
    return client.create_session(source.calibration, name=name, mode="live")


def _messages(session: Session, source: Source, record: Path | None) -> Iterator[FrameMessage]:
    if record is None:
        for frame in source.frames():
            yield session.frame(frame.rgb, frame.depth, frame.t_ns)
        return
    with Recorder(record, source.calibration) as recorder:
        for frame in source.frames():
            recorder.frame(_encoded(frame))
            yield session.frame(frame.rgb, frame.depth, frame.t_ns)


def _encoded(frame: CameraFrame) -> SequenceFrame:
    rgb, depth = frame.rgb, frame.depth
    if not isinstance(rgb, ColourImage):
        rgb = ColourImage(ColourEncoding.RGB8, rgb.tobytes())
    if not isinstance(depth, DepthImage):
        depth = encode_depth(depth, DepthEncoding.RAW16)
    return SequenceFrame(frame.t_ns, "", rgb, depth, None)


def _line(reply: FrameReply) -> str:
    if reply.error is not None:
        return f"{reply.seq}: {reply.error.field}: {reply.error.reason}"
    return f"{reply.seq}: {reply.status}{_position(reply.T_map_camera)}"


def _place(reply: LocalizeReply) -> str:
    return _position(reply.T_map_camera) or f" ({reply.reason})"


def _position(pose: Pose | None) -> str:
    if pose is None:
        return ""
    p = pose.position
    return f" at {p.x:.3f} {p.y:.3f} {p.z:.3f} m"
