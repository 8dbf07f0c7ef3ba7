"""Files of many pictures: videos that browsers play, and archives with poses."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from services.gateway.colour_maps import picture
from services.gateway.path_renders.views import PathViews
from services.gateway.views import DEPTH_SCALE, millimetres
from shared import codec, images
from shared.errors import StorageError
from shared.maps import RenderReply
from shared.path_renders import PathFormat
from shared.trajectories import TrajectoryFormat, trajectory_text

MEDIA_TYPES = {
    PathFormat.WEBM: "video/webm",
    PathFormat.MP4: "video/mp4",
    PathFormat.JPEG: "application/zip",
    PathFormat.PNG: "application/zip",
}
SUFFIXES = {
    PathFormat.WEBM: "webm",
    PathFormat.MP4: "mp4",
    PathFormat.JPEG: "zip",
    PathFormat.PNG: "zip",
}
# MPEG-4 part 2, which OpenCV writes faster, no browser plays; it has no encoder for H.264.
_CODECS = {PathFormat.WEBM: "VP80", PathFormat.MP4: "vp09"}


class PictureFile(Protocol):
    """Takes one render after the other."""

    def add(self, reply: RenderReply) -> None:
        """Write the next picture.

        Raises:
            OSError: the disk refused.
        """

    def close(self) -> None:
        """End the file."""


def open_file(path: Path, views: PathViews) -> PictureFile:
    """A file for the views of a path.

    Raises:
        StorageError, OSError: the disk refused.
    """
    if views.request.format in _CODECS:
        return _Video(path, views)
    return _Archive(path, views)


class _Video:
    def __init__(self, path: Path, views: PathViews) -> None:
        self._views = views
        self._size = (views.size.width & ~1, views.size.height & ~1)  # colour is halved both ways
        format, fps = views.request.format, views.request.fps
        fourcc = cv2.VideoWriter.fourcc(*_CODECS[format])
        self._writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, fps, self._size)
        if not self._writer.isOpened():
            raise StorageError(f"no {format} video of {self._size} pixels can be written")

    def add(self, reply: RenderReply) -> None:
        rgb = picture(reply, self._views.request.layer, self._views.depth_range_m).rgb
        width, height = self._size
        self._writer.write(np.ascontiguousarray(rgb[:height, :width, ::-1]))

    def close(self) -> None:
        self._writer.release()


class _Archive:
    """Numbered pictures, and from where they were drawn: poses.txt (TUM) and camera.json."""

    def __init__(self, path: Path, views: PathViews) -> None:
        self._views = views
        self._zip = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED)  # pictures are packed already
        self._count = 0
        stamps_ns = (round(i * 1e9 / views.request.fps) for i in range(len(views.T_map_cameras)))
        poses = zip(stamps_ns, views.T_map_cameras, strict=True)
        self._zip.writestr("poses.txt", trajectory_text(poses, TrajectoryFormat.TUM))
        self._zip.writestr("camera.json", json.dumps(self._camera(), indent=1))

    def _camera(self) -> dict:
        request = self._views.request
        about = {"intrinsics": codec.to_json(self._views.size), "layer": request.layer}
        if request.layer == "depth" and request.format is PathFormat.PNG:
            about["depth_scale"] = DEPTH_SCALE
        return about

    def add(self, reply: RenderReply) -> None:
        name = f"{self._count:06d}.{self._views.request.format}"
        self._zip.writestr(name, self._encode(reply))
        self._count += 1

    def _encode(self, reply: RenderReply) -> bytes:
        layer = self._views.request.layer
        if self._views.request.format is PathFormat.JPEG:
            return images.encode_jpeg(picture(reply, layer, self._views.depth_range_m).rgb).bytes
        if layer == "depth":
            return images.encode_png(millimetres(reply.depth_m))
        return images.encode_png(reply.rgb if layer == "colour" else reply.confidence)

    def close(self) -> None:
        self._zip.close()
