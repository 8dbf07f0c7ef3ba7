"""ScanNet++ (Yeshwanth et al. 2023), iPhone and DSLR, as its toolkit lays them out.

iPhone: iphone/rgb/frame_000000.jpg and iphone/depth/frame_000000.png (extracted from rgb.mkv and
depth.bin by the toolkit), iphone/pose_intrinsic_imu.json. Depth is 256x192, colour 1920x1440.

DSLR: dslr/resized_images/DSC*.JPG (fisheye) with dslr/nerfstudio/transforms.json, or
dslr/resized_undistorted_images with transforms_undistorted.json; dslr/train_test_lists.json; depth
rendered from the laser mesh by the toolkit into dslr/render_depth. The train list is the sequence,
the test list are views off the trajectory. The world of transforms.json is a rotated one; that is
no matter, since every score aligns trajectories first.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pointslam.datasets.base import (
    FileSequence,
    FrameFiles,
    SequenceOptions,
    depth_intrinsics,
    image_size,
)
from pointslam.datasets.lists import read_json
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import SequenceError

DEPTH_SCALE = 1000.0
_OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def is_iphone(path: Path) -> bool:
    """Whether this is the iphone folder of a scene."""
    return (path / "pose_intrinsic_imu.json").is_file()


def is_dslr(path: Path) -> bool:
    """Whether this is the dslr folder of a scene."""
    return (path / "train_test_lists.json").is_file()


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


def read_iphone(path: Path, options: SequenceOptions) -> FileSequence:
    """Read an iPhone recording: frames whose colour and depth have been extracted."""
    file = path / "pose_intrinsic_imu.json"
    records = read_json(file)
    try:
        ordered = sorted(records.items(), key=lambda item: float(item[1]["timestamp"]))
        matrices = np.array([record["intrinsic"] for _, record in ordered], np.float64)
        frames = tuple(_iphone_frames(path, ordered))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise SequenceError(file, f"field missing or of the wrong kind: {error}") from None
    if not frames:
        raise SequenceError(path, "no frame lies in both rgb/ and depth/: extract rgb.mkv first")
    calibration = _iphone_calibration(frames[0], np.median(matrices, axis=0), options)
    return FileSequence(_scene_name(path), path, calibration, frames)


def _iphone_frames(path: Path, ordered: list[tuple[str, Any]]) -> Iterable[FrameFiles]:
    for name, record in ordered:
        rgb, depth = path / "rgb" / f"{name}.jpg", path / "depth" / f"{name}.png"
        if rgb.is_file() and depth.is_file():
            seconds = float(record["timestamp"])
            pose = np.array(record["aligned_pose"], np.float64).reshape(4, 4)
            truth = pose if np.isfinite(pose).all() else None
            yield FrameFiles(round(seconds * 1e9), f"{seconds:.6f}", rgb, depth, truth)


def _iphone_calibration(
    first: FrameFiles, matrix: np.ndarray, options: SequenceOptions
) -> Calibration:
    # The lens refocuses, so the intrinsics of single frames differ by a few pixels of 1600.
    width, height = image_size(first.rgb)
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return _calibration(Camera(Intrinsics(fx, fy, cx, cy, width, height)), first, options)


def read_dslr(path: Path, options: SequenceOptions) -> FileSequence:
    """Read a DSLR recording; depth must have been rendered."""
    images, file = _dslr_images(path)
    fields = read_json(file)
    lists = read_json(path / "train_test_lists.json")
    try:
        camera = _dslr_camera(fields)
        poses = _dslr_poses(fields)
        frames = tuple(_dslr_frames(path, images, lists["train"], poses))
        views = tuple(f for f in _dslr_frames(path, images, lists["test"], poses) if _has_pose(f))
    except (KeyError, TypeError, ValueError) as error:
        raise SequenceError(file, f"field missing or of the wrong kind: {error}") from None
    with_depth = tuple(frame for frame in frames if frame.depth is not None)
    if not with_depth:
        raise SequenceError(path / "render_depth", "holds no depth: render it with the toolkit")
    calibration = _calibration(camera, with_depth[0], options)
    return FileSequence(_scene_name(path), path, calibration, with_depth, views)


def _dslr_images(path: Path) -> tuple[Path, Path]:
    nerfstudio = path / "nerfstudio"
    if (path / "resized_undistorted_images").is_dir():
        return path / "resized_undistorted_images", nerfstudio / "transforms_undistorted.json"
    return path / "resized_images", nerfstudio / "transforms.json"


def _dslr_camera(fields: dict[str, Any]) -> Camera:
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


def _dslr_poses(fields: dict[str, Any]) -> dict[str, np.ndarray]:
    entries = [*fields["frames"], *fields.get("test_frames", [])]
    return {
        Path(entry["file_path"]).name: np.array(entry["transform_matrix"], np.float64)
        @ _OPENCV_OPENGL
        for entry in entries
    }


def _dslr_frames(
    path: Path, images: Path, names: list[str], poses: dict[str, np.ndarray]
) -> Iterable[FrameFiles]:
    for second, name in enumerate(names):  # still pictures: a second apart, in the list's order
        depth = path / "render_depth" / f"{Path(name).stem}.png"
        known = depth if depth.is_file() else None
        yield FrameFiles(second * 10**9, f"{second}.0", images / name, known, poses.get(name))


def _has_pose(files: FrameFiles) -> bool:
    return files.T_world_camera is not None


def _calibration(camera: Camera, first: FrameFiles, options: SequenceOptions) -> Calibration:
    assert first.depth is not None
    other = depth_intrinsics(camera.intrinsics, image_size(first.depth))
    depth = None if other is None else Camera(other, camera.distortion, camera.fisheye)
    return Calibration(camera, float(options.depth_scale or DEPTH_SCALE), depth)


def _scene_name(path: Path) -> str:
    resolved = path.resolve()
    return f"{resolved.parent.name}-{resolved.name}"
