"""Recorded sequences: one file a format, found by what lies in the folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pointslam.datasets.base import (
    FileSequence,
    Sequence,
    SequenceFrame,
    SequenceOptions,
    View,
    is_held_out,
)
from pointslam.datasets.folder import is_folder, read_folder
from pointslam.datasets.mcap import is_mcap, read_mcap
from pointslam.datasets.replica import is_replica, read_replica
from pointslam.datasets.scannetpp import is_scene, read_scene
from pointslam.datasets.scannetpp_dslr import is_dslr, read_dslr
from pointslam.datasets.scannetpp_iphone import is_iphone, read_iphone
from pointslam.datasets.seven_scenes import is_seven_scenes, read_seven_scenes
from pointslam.datasets.tum import is_tum, read_tum
from shared.errors import SequenceError

__all__ = [
    "FileSequence",
    "Sequence",
    "SequenceFrame",
    "SequenceOptions",
    "View",
    "is_held_out",
    "open_sequence",
]

Detect = Callable[[Path], bool]
Read = Callable[[Path, SequenceOptions], FileSequence]

# Asked in this order: our own folders have TUM's lists too.
FORMATS: dict[str, tuple[Detect, Read]] = {
    "calibration.json folder": (is_folder, read_folder),
    "TUM RGB-D": (is_tum, read_tum),
    "Replica": (is_replica, read_replica),
    "7-Scenes": (is_seven_scenes, read_seven_scenes),
    "ScanNet++ scene": (is_scene, read_scene),
    "ScanNet++ iPhone": (is_iphone, read_iphone),
    "ScanNet++ DSLR": (is_dslr, read_dslr),
}


def open_sequence(path: Path | str, options: SequenceOptions | None = None) -> FileSequence:
    """Open a folder of any format we know, or an MCAP file.

    Raises:
        SequenceError: names the file that cannot be read and what is wrong with it.
    """
    path = Path(path)
    if is_mcap(path):
        return read_mcap(path, options or SequenceOptions())
    if not path.is_dir():
        found = "is no folder and no .mcap file" if path.exists() else "does not exist"
        raise SequenceError(path, found)
    for detect, read in FORMATS.values():
        if detect(path):
            return read(path, options or SequenceOptions())
    raise SequenceError(path, f"is of no known format; known are {', '.join(FORMATS)}")
