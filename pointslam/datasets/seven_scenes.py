"""7-Scenes (Shotton et al. 2013): frame-000000.color.png, .depth.png and .pose.txt in seq-01.

Depth is *not* registered to colour and the poses are of the depth camera. The published focal
lengths are 585 px (depth) and 525 px (colour); the transform between the cameras is not published.
Ours is the Kinect's nominal 25 mm baseline; a `calibration.json` in the sequence's or the scene's
folder with `raw_depth` and `depth_to_colour` replaces all of it.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from pointslam.datasets.base import FileSequence, FrameFiles, SequenceOptions
from pointslam.datasets.folder import read_calibration
from pointslam.datasets.lists import read_matrices
from shared import se3
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import SequenceError

RATE_HZ = 30

NOMINAL = Calibration(
    colour=Camera(Intrinsics(525.0, 525.0, 320.0, 240.0, 640, 480)),
    depth=Camera(Intrinsics(585.0, 585.0, 320.0, 240.0, 640, 480)),
    depth_scale=1000.0,
    T_colour_depth=se3.from_rotation(np.eye(3), [-0.025, 0.0, 0.0]),
)


def is_seven_scenes(path: Path) -> bool:
    """Whether this format's files lie here."""
    return any(path.glob("frame-*.color.png"))


def read_seven_scenes(path: Path, options: SequenceOptions) -> FileSequence:
    """Read one `seq-XX` folder; pose files may be absent."""
    calibration = _calibration(path, options)
    colours = sorted(path.glob("frame-*.color.png"), key=_number)
    frames = tuple(_frame(path, _number(rgb), rgb, calibration) for rgb in colours)
    name = f"{path.resolve().parent.name}-{path.resolve().name}"
    return FileSequence(name, path, calibration, frames)


def _calibration(path: Path, options: SequenceOptions) -> Calibration:
    for folder in (path, path.resolve().parent):
        file = folder / "calibration.json"
        if file.is_file():
            return read_calibration(file, replace(options, raw_depth=True))
    return replace(NOMINAL, depth_scale=float(options.depth_scale or NOMINAL.depth_scale))


def _frame(path: Path, number: int, rgb: Path, calibration: Calibration) -> FrameFiles:
    stem = rgb.name.removesuffix(".color.png")
    pose_file = path / f"{stem}.pose.txt"
    T_world_colour = None
    if pose_file.is_file():
        matrices = read_matrices(pose_file)
        if len(matrices) != 1:
            raise SequenceError(pose_file, f"must hold one 4x4 matrix, got {len(matrices)}")
        T_world_colour = matrices[0] @ se3.inverse(calibration.T_colour_depth)
    stamp = f"{number / RATE_HZ:.6f}"
    depth = path / f"{stem}.depth.png"
    return FrameFiles(number * 10**9 // RATE_HZ, stamp, rgb, depth, T_world_colour)


def _number(path: Path) -> int:
    found = re.fullmatch(r"frame-(\d+)\.color\.png", path.name)
    if found is None:
        raise SequenceError(path, "must be named frame-000000.color.png with a number")
    return int(found.group(1))
