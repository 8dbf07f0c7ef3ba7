"""ScanNet++'s DSLR recordings, whose depth the toolkit renders from the laser mesh.

dslr/resized_images/DSC*.JPG (fisheye) with dslr/nerfstudio/transforms.json or, where that is
absent, the COLMAP model in dslr/colmap; or dslr/resized_undistorted_images with
transforms_undistorted.json; dslr/train_test_lists.json; dslr/render_depth. The train list is the
sequence, the test list are views off the trajectory. The world of transforms.json is a rotated
one; that is no matter, since every score aligns trajectories first.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pointslam.datasets.base import FileSequence, FrameFiles, SequenceOptions, image_size
from pointslam.datasets.colmap import has_colmap, read_colmap
from pointslam.datasets.lists import read_json
from pointslam.datasets.scannetpp_calibration import calibration, scene_name
from shared.camera import Camera, Intrinsics
from shared.errors import SequenceError
from shared.se3 import Matrix

_OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_LISTS = "train_test_lists.json"


def is_dslr(path: Path) -> bool:
    """Whether this is the dslr folder of a scene."""
    return (path / _LISTS).is_file()


@dataclass(frozen=True)
class _Pictures:
    """A folder of images of one camera, with their poses by name."""

    folder: Path
    camera: Camera
    poses: dict[str, Matrix]


def read_dslr(path: Path, options: SequenceOptions) -> FileSequence:
    """Read a DSLR recording; depth must have been rendered."""
    pictures = _pictures(path)
    lists = read_json(path / _LISTS)
    try:
        frames = tuple(_frames(path, pictures, lists["train"]))
        views = tuple(f for f in _frames(path, pictures, lists["test"]) if _has_pose(f))
    except (KeyError, TypeError, ValueError) as error:
        reason = f"field missing or of the wrong kind: {error}"
        raise SequenceError(path / _LISTS, reason) from None
    with_depth = tuple(frame for frame in frames if frame.depth is not None)
    if not with_depth:
        raise SequenceError(path / "render_depth", "holds no depth: render it with the toolkit")
    assert with_depth[0].depth is not None
    device = calibration(pictures.camera, image_size(with_depth[0].depth), options)
    return FileSequence(scene_name(path), path, device, with_depth, views)


def _pictures(path: Path) -> _Pictures:
    nerfstudio = path / "nerfstudio"
    undistorted = path / "resized_undistorted_images", nerfstudio / "transforms_undistorted.json"
    if undistorted[0].is_dir() and undistorted[1].is_file():
        return _nerfstudio(*undistorted)
    distorted = path / "resized_images", nerfstudio / "transforms.json"
    if not distorted[1].is_file() and has_colmap(path / "colmap"):
        model = read_colmap(path / "colmap")
        return _Pictures(distorted[0], model.camera, model.poses)
    return _nerfstudio(*distorted)


def _nerfstudio(images: Path, file: Path) -> _Pictures:
    fields = read_json(file)
    try:
        return _Pictures(images, _camera(fields), _poses(fields))
    except (KeyError, TypeError, ValueError) as error:
        raise SequenceError(file, f"field missing or of the wrong kind: {error}") from None


def _camera(fields: dict[str, Any]) -> Camera:
    intrinsics = Intrinsics(
        fx=float(fields["fl_x"]),
        fy=float(fields["fl_y"]),
        cx=float(fields["cx"]) - 0.5,  # COLMAP's first pixel has its centre at (0.5, 0.5)
        cy=float(fields["cy"]) - 0.5,
        width=int(fields["w"]),
        height=int(fields["h"]),
    )
    if fields["camera_model"] != "OPENCV_FISHEYE":
        return Camera(intrinsics)
    coefficients = tuple(float(fields[k]) for k in ("k1", "k2", "k3", "k4"))
    return Camera(intrinsics, coefficients, fisheye=True)


def _poses(fields: dict[str, Any]) -> dict[str, Matrix]:
    entries = [*fields["frames"], *fields.get("test_frames", [])]
    return {
        Path(entry["file_path"]).name: np.array(entry["transform_matrix"], np.float64)
        @ _OPENCV_OPENGL
        for entry in entries
    }


def _frames(path: Path, pictures: _Pictures, names: list[str]) -> Iterable[FrameFiles]:
    for second, name in enumerate(names):  # still pictures: a second apart, in the list's order
        depth = path / "render_depth" / f"{Path(name).stem}.png"
        known = depth if depth.is_file() else None
        rgb, T_world_camera = pictures.folder / name, pictures.poses.get(name)
        yield FrameFiles(second * 10**9, f"{second}.0", rgb, known, T_world_camera)


def _has_pose(files: FrameFiles) -> bool:
    return files.T_world_camera is not None
