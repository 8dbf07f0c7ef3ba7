"""Cameras and recordings as clients of a gateway."""

from pointslam.bridges.source import CameraFrame, RecordedSource, Source
from pointslam.bridges.stream import StreamRequest, localize_video, stream_source

__all__ = [
    "CameraFrame",
    "RecordedSource",
    "Source",
    "StreamRequest",
    "localize_video",
    "stream_source",
]
