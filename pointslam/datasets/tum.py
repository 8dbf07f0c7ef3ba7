"""TUM RGB-D benchmark (Sturm et al. 2012): rgb.txt, depth.txt, groundtruth.txt.

The lists have different stamps and are joined by the nearest ones. The calibration is not in the
folder; it is known from the camera in the folder's name (freiburg1, fr1, ...). Depth is registered
to the distorted colour image, in 1/5000 m; fr2's other published factor is 5208
(`SequenceOptions.depth_scale`).
"""

from __future__ import annotations

import re
from pathlib import Path

from pointslam.datasets.base import FileSequence, SequenceOptions
from pointslam.datasets.lists import join_lists, read_file_list, read_trajectory
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import SequenceError

DEPTH_SCALE = 5000.0

CAMERAS = {
    "1": Camera(
        Intrinsics(517.306408, 516.469215, 318.643040, 255.313989, 640, 480),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "2": Camera(
        Intrinsics(520.908620, 521.007327, 325.141442, 249.701764, 640, 480),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "3": Camera(Intrinsics(535.4, 539.2, 320.1, 247.6, 640, 480)),
}


def is_tum(path: Path) -> bool:
    """Whether this format's files lie here."""
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def read_tum(path: Path, options: SequenceOptions) -> FileSequence:
    """Read a sequence of the benchmark."""
    scale = options.depth_scale or DEPTH_SCALE
    calibration = Calibration(_camera(path), float(scale))
    frames = join_lists(
        read_file_list(path / "rgb.txt"),
        read_file_list(path / "depth.txt"),
        read_trajectory(path / "groundtruth.txt"),
        options.max_association_s,
    )
    return FileSequence(path.name, path, calibration, frames)


def _camera(path: Path) -> Camera:
    found = re.search(r"(?:freiburg|fr)([123])", path.resolve().name.lower())
    if found is None:
        raise SequenceError(
            path,
            "a TUM folder's name must hold freiburg1, freiburg2 or freiburg3, which says its "
            "calibration; for another camera put a calibration.json beside rgb.txt",
        )
    return CAMERAS[found.group(1)]
