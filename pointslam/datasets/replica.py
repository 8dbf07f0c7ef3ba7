"""Replica as rendered for NICE-SLAM: traj.txt, results/frame*.jpg, results/depth*.png.

`cam_params.json` lies in the data set's root, or in the scene. Frames have no stamps: 30 a second.
"""

from __future__ import annotations

from pathlib import Path

from pointslam.datasets.base import FileSequence, FrameFiles, SequenceOptions
from pointslam.datasets.lists import read_json, read_matrices
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import SequenceError

RATE_HZ = 30


def is_replica(path: Path) -> bool:
    """Whether this format's files lie here."""
    return (path / "results").is_dir() and _cam_params(path) is not None


def read_replica(path: Path, options: SequenceOptions) -> FileSequence:
    """Read a scene; `traj.txt` may be absent."""
    trajectory = path / "traj.txt"
    truths = read_matrices(trajectory) if trajectory.is_file() else None
    colours = sorted((path / "results").glob("frame*"), key=_number)
    if truths is not None and len(truths) < len(colours):
        raise SequenceError(trajectory, f"{len(truths)} poses for {len(colours)} frames")
    frames = []
    for i, rgb in enumerate(colours):
        depth = rgb.with_name(f"depth{rgb.stem.removeprefix('frame')}.png")
        truth = None if truths is None else truths[i]
        frames.append(FrameFiles(i * 10**9 // RATE_HZ, f"{i / RATE_HZ:.6f}", rgb, depth, truth))
    return FileSequence(path.name, path, _calibration(path, options), tuple(frames))


def _cam_params(path: Path) -> Path | None:
    for folder in (path, path.resolve().parent):
        if (folder / "cam_params.json").is_file():
            return folder / "cam_params.json"
    return None


def _calibration(path: Path, options: SequenceOptions) -> Calibration:
    file = _cam_params(path)
    assert file is not None
    try:
        camera = read_json(file)["camera"]
        intrinsics = Intrinsics(
            fx=float(camera["fx"]),
            fy=float(camera["fy"]),
            cx=float(camera["cx"]),
            cy=float(camera["cy"]),
            width=int(camera["w"]),
            height=int(camera["h"]),
        )
        scale = float(options.depth_scale or camera["scale"])
    except (KeyError, TypeError, ValueError) as error:
        raise SequenceError(file, f"field missing or of the wrong kind: {error}") from None
    return Calibration(Camera(intrinsics), scale)


def _number(path: Path) -> int:
    digits = path.stem.removeprefix("frame")
    if not digits.isdigit():
        raise SequenceError(path, "must be named frame000000.jpg with a number")
    return int(digits)
