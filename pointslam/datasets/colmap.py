"""A COLMAP model's camera and poses: cameras and images, as text or binary."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from shared import se3
from shared.camera import Camera, Intrinsics
from shared.errors import InputError, SequenceError
from shared.se3 import Matrix

T = TypeVar("T")

# COLMAP's number of the model, and how many parameters it has.
_MODELS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
}
_IMAGE = struct.Struct("<I7dI")  # id, quaternion w x y z, translation, camera
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_POINT_BYTES = 24


@dataclass(frozen=True)
class ColmapModel:
    """One camera, and `T_world_camera` of each image by its name."""

    camera: Camera
    poses: dict[str, Matrix]


def has_colmap(path: Path) -> bool:
    """Whether a model lies in this folder."""
    return _is_text(path) or (path / "images.bin").is_file()


def read_colmap(path: Path) -> ColmapModel:
    """Read a model whose images share one camera.

    Raises:
        SequenceError: a file is absent or damaged, or of several or unknown cameras.
    """
    if _is_text(path):
        camera = _parse(path / "cameras.txt", _camera_text)
        return ColmapModel(camera, _parse(path / "images.txt", _poses_text))
    camera = _parse(path / "cameras.bin", _camera_binary)
    return ColmapModel(camera, _parse(path / "images.bin", _poses_binary))


def _is_text(path: Path) -> bool:
    return (path / "images.txt").is_file()


def _parse(file: Path, read: Callable[[bytes], T]) -> T:
    try:
        return read(file.read_bytes())
    except OSError as error:
        raise SequenceError(file, f"cannot be read ({error.strerror})") from None
    except (ValueError, IndexError, struct.error, InputError) as error:
        raise SequenceError(file, f"is no COLMAP model that can be used: {error}") from None


def _camera_text(data: bytes) -> Camera:
    rows = [line.split() for line in data.decode().splitlines()]
    rows = [words for words in rows if words and not words[0].startswith("#")]
    if len(rows) != 1:
        raise ValueError(f"must hold one camera, got {len(rows)}")
    _, model, width, height, *parameters = rows[0]
    return _camera(model, (int(width), int(height)), [float(p) for p in parameters])


def _camera_binary(data: bytes) -> Camera:
    (count,) = struct.unpack_from("<Q", data)
    if count != 1:
        raise ValueError(f"must hold one camera, got {count}")
    _, number, width, height = _CAMERA.unpack_from(data, 8)
    names = {number: name for name, (number, _) in _MODELS.items()}
    model = names.get(number, f"number {number}")
    length = _MODELS.get(model, (0, 0))[1]
    parameters = struct.unpack_from(f"<{length}d", data, 8 + _CAMERA.size)
    return _camera(model, (width, height), list(parameters))


def _camera(model: str, size: tuple[int, int], parameters: list[float]) -> Camera:
    if model not in _MODELS:
        raise ValueError(f"camera model {model} is unknown; known are {', '.join(_MODELS)}")
    if len(parameters) != _MODELS[model][1]:
        raise ValueError(f"{model} has {_MODELS[model][1]} parameters, got {len(parameters)}")
    if model == "SIMPLE_PINHOLE":
        parameters = [parameters[0], *parameters]
    fx, fy, cx, cy, *distortion = parameters
    # COLMAP's first pixel has its centre at (0.5, 0.5).
    intrinsics = Intrinsics(fx, fy, cx - 0.5, cy - 0.5, *size)
    return Camera(intrinsics, tuple(distortion), fisheye=model == "OPENCV_FISHEYE")


def _poses_text(data: bytes) -> dict[str, Matrix]:
    lines = [line for line in data.decode().splitlines() if not line.startswith("#")]
    while lines and not lines[0].strip():
        lines.pop(0)
    return dict(_pose_of_line(line) for line in lines[::2] if line.strip())  # then its points


def _pose_of_line(line: str) -> tuple[str, Matrix]:
    words = line.split(maxsplit=9)
    return words[9].strip(), _pose([float(word) for word in words[1:8]])


def _poses_binary(data: bytes) -> dict[str, Matrix]:
    (count,) = struct.unpack_from("<Q", data)
    at, poses = 8, dict[str, Matrix]()
    for _ in range(count):
        _, *values, _ = _IMAGE.unpack_from(data, at)
        at += _IMAGE.size
        end = data.index(b"\0", at)
        poses[data[at:end].decode()] = _pose(values)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + points * _POINT_BYTES
    return poses


def _pose(values: list[float]) -> Matrix:
    w, x, y, z, *translation = values
    return se3.inverse(se3.from_quat_xyzw([x, y, z, w], translation))
