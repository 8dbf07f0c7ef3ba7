"""ScanNet++'s iPhone recordings, as published or as the toolkit extracts them.

Published: iphone/rgb.mkv, iphone/depth.bin, iphone/pose_intrinsic_imu.json (rgb_masks.mkv is not
used). Extracted: iphone/rgb/frame_000000.jpg and iphone/depth/frame_000000.png, which are taken
first, since their bytes pass through; a video's frames are encoded anew as JPEG of quality 95.
Depth is 256x192, colour 1920x1440.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pointslam.datasets.base import (
    FileSequence,
    FrameFiles,
    FrameReader,
    ImageFiles,
    SequenceOptions,
    image_size,
)
from pointslam.datasets.iphone_depth import HEIGHT, WIDTH, DepthFile, open_depth
from pointslam.datasets.lists import read_json
from pointslam.datasets.scannetpp_calibration import calibration, scene_name
from pointslam.datasets.video import Video
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import SequenceError
from shared.frames import ColourImage, DepthEncoding, DepthImage
from shared.images import encode_depth, encode_jpeg

_JPEG_QUALITY = 95
_POSES = "pose_intrinsic_imu.json"
Records = list[tuple[str, Any]]  # a frame's name and what is known of it, by time


def is_iphone(path: Path) -> bool:
    """Whether this is the iphone folder of a scene."""
    return (path / _POSES).is_file()


def read_iphone(path: Path, options: SequenceOptions) -> FileSequence:
    """Read an iPhone recording: extracted images, or else the video and `depth.bin`."""
    file = path / _POSES
    records = read_json(file)
    try:
        ordered = sorted(records.items(), key=lambda item: float(item[1]["timestamp"]))
        matrices = np.array([record["intrinsic"] for _, record in ordered], np.float64)
        frames, reader, sizes = _frames(path, ordered)
        device = _calibration(sizes, np.median(matrices, axis=0), options)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise SequenceError(file, f"field missing or of the wrong kind: {error}") from None
    return FileSequence(scene_name(path), path, device, frames, reader=reader)


@dataclass(frozen=True)
class _Sizes:
    colour: tuple[int, int]  # width, height
    depth: tuple[int, int]


@dataclass(frozen=True)
class _Recording:
    """The video and `depth.bin`; a frame's number counts in both."""

    video: Video
    depths: DepthFile

    def colour(self, files: FrameFiles) -> ColourImage:
        """A frame of the video as JPEG."""
        return encode_jpeg(self.video.frame(files.number), _JPEG_QUALITY)

    def depth(self, files: FrameFiles) -> DepthImage:
        """A frame of `depth.bin`, millimetres."""
        return encode_depth(self.depths.frame_mm(files.number), DepthEncoding.PNG16)


def _frames(path: Path, ordered: Records) -> tuple[tuple[FrameFiles, ...], FrameReader, _Sizes]:
    frames = tuple(_extracted(path, ordered))
    if frames:
        assert frames[0].depth is not None
        sizes = _Sizes(image_size(frames[0].rgb), image_size(frames[0].depth))
        return frames, ImageFiles(), sizes
    rgb, depth = path / "rgb.mkv", path / "depth.bin"
    if not (rgb.is_file() and depth.is_file()):
        raise SequenceError(path, "holds neither rgb.mkv and depth.bin nor images from both")
    recording = _Recording(Video(rgb), open_depth(depth))
    height, width = recording.video.frame(0).shape[:2]
    frames = tuple(_recorded(rgb, depth, ordered, recording))
    return frames, recording, _Sizes((width, height), (WIDTH, HEIGHT))


def _extracted(path: Path, ordered: Records) -> Iterator[FrameFiles]:
    for name, record in ordered:
        rgb, depth = path / "rgb" / f"{name}.jpg", path / "depth" / f"{name}.png"
        if rgb.is_file() and depth.is_file():
            yield _frame(rgb, depth, record, 0)


def _recorded(
    rgb: Path, depth: Path, ordered: Records, recording: _Recording
) -> Iterator[FrameFiles]:
    count = min(len(recording.video), len(recording.depths))
    for name, record in ordered:
        number = int(name.removeprefix("frame_"))
        if number < count:
            yield _frame(rgb, depth, record, number)


def _frame(rgb: Path, depth: Path, record: dict[str, Any], number: int) -> FrameFiles:
    seconds = float(record["timestamp"])
    pose = np.array(record["aligned_pose"], np.float64).reshape(4, 4)
    truth = pose if np.isfinite(pose).all() else None
    return FrameFiles(round(seconds * 1e9), f"{seconds:.6f}", rgb, depth, truth, number)


def _calibration(sizes: _Sizes, matrix: np.ndarray, options: SequenceOptions) -> Calibration:
    # The lens refocuses, so the intrinsics of single frames differ by a few pixels of 1600.
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    camera = Camera(Intrinsics(fx, fy, cx, cy, *sizes.colour))
    return calibration(camera, sizes.depth, options)
