"""Our own folders: `calibration.json` beside TUM-style lists, `novel/` for views off the path.

`calibration.json` holds width, height, fx, fy, cx, cy, depth_scale and optionally distortion
(a list of OpenCV coefficients). Where depth was also recorded unregistered, `raw_depth` has the
depth camera's fields, `depth_to_colour` the 4x4 transform and `depth_raw.txt` the files.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pointslam.datasets.base import FileSequence, FrameFiles, SequenceOptions
from pointslam.datasets.lists import join_lists, read_file_list, read_json, read_trajectory
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import SequenceError


def is_folder(path: Path) -> bool:
    """Whether this format's files lie here."""
    return (path / "calibration.json").is_file() and (path / "rgb.txt").is_file()


def read_folder(path: Path, options: SequenceOptions) -> FileSequence:
    """Read a folder; its depth is registered to colour unless `options.raw_depth`."""
    calibration = read_calibration(path / "calibration.json", options)
    depth_list = "depth_raw.txt" if options.raw_depth else "depth.txt"
    frames = join_lists(
        read_file_list(path / "rgb.txt"),
        read_file_list(path / depth_list),
        read_trajectory(path / "groundtruth.txt"),
        options.max_association_s,
    )
    views = () if options.raw_depth else _read_views(path / "novel")
    return FileSequence(path.name, path, calibration, frames, views)


def read_calibration(path: Path, options: SequenceOptions) -> Calibration:
    """The device of a `calibration.json`."""
    fields = read_json(path)
    try:
        calibration = Calibration(_camera(fields), float(fields["depth_scale"]))
        if options.raw_depth:
            raw = fields["raw_depth"]
            calibration = replace(
                calibration,
                depth=_camera(raw),
                depth_scale=float(raw["depth_scale"]),
                T_colour_depth=np.array(fields["depth_to_colour"], np.float64),
            )
    except (KeyError, TypeError, ValueError) as error:
        raise SequenceError(path, f"field missing or of the wrong kind: {error}") from None
    if options.depth_scale is not None:
        calibration = replace(calibration, depth_scale=float(options.depth_scale))
    return calibration


def _camera(fields: dict[str, Any]) -> Camera:
    focal_and_centre = {name: float(fields[name]) for name in ("fx", "fy", "cx", "cy")}
    size = {name: int(fields[name]) for name in ("width", "height")}
    distortion = fields.get("distortion", "none")
    coefficients = () if distortion == "none" else tuple(float(k) for k in distortion)
    return Camera(Intrinsics(**focal_and_centre, **size), coefficients)


def _read_views(path: Path) -> tuple[FrameFiles, ...]:
    views = []
    for pose in read_trajectory(path / "groundtruth.txt"):
        rgb = path / "rgb" / f"{pose.stamp}.jpg"
        if not rgb.is_file():
            rgb = rgb.with_suffix(".png")
        depth = path / "depth" / f"{pose.stamp}.png"
        depth = depth if depth.is_file() else None
        views.append(FrameFiles(pose.t_ns, pose.stamp, rgb, depth, pose.T_world_camera))
    return tuple(views)
