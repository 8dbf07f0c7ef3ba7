"""A ScanNet++ scene (Yeshwanth et al. 2023): a folder with an `iphone` and a `dslr` recording."""

from __future__ import annotations

from pathlib import Path

from pointslam.datasets.base import FileSequence, SequenceOptions
from pointslam.datasets.scannetpp_dslr import is_dslr, read_dslr
from pointslam.datasets.scannetpp_iphone import is_iphone, read_iphone
from shared.errors import SequenceError


def is_scene(path: Path) -> bool:
    """Whether this is a scene's folder, with an iPhone or a DSLR recording in it."""
    return is_iphone(path / "iphone") or is_dslr(path / "dslr")


def read_scene(path: Path, options: SequenceOptions) -> FileSequence:
    """The DSLR recording where its depth is rendered, else the iPhone's."""
    if is_dslr(path / "dslr") and (path / "dslr" / "render_depth").is_dir():
        return read_dslr(path / "dslr", options)
    if is_iphone(path / "iphone"):
        return read_iphone(path / "iphone", options)
    raise SequenceError(path / "dslr" / "render_depth", "is absent: render depth with the toolkit")
