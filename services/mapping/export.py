"""The map as files: 3DGS splats (PLY), and the session's folder (tar)."""

from __future__ import annotations

import tarfile
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from services.mapping.baking import BakedGaussians
from services.mapping.snapshot import snapshot_folders
from services.mapping.storage import storage_errors

_PACKED = (".msgpack", ".bin")
_FIRST = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
_COUNT_DIGITS = 20  # a count has at most
_LAST = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def write_ply(file: BinaryIO, blocks: Iterable[BakedGaussians], degree: int) -> None:
    """Gaussians in the binary PLY that splat viewers read, block by block: a map has gigabytes.

    Opacity as a logit, scales as logarithms, quaternions wxyz, coefficients of one colour after
    those of another.

    Args:
        file: at its start; its beginning is written again when the number of Gaussians is known.
        blocks: parts of the map.
        degree: of their harmonics.
    """
    count = 0
    file.write(_ply_header(count, degree))
    for block in blocks:
        vertices = _ply_vertices(block)
        file.write(vertices.tobytes())
        count += len(vertices)
    file.seek(0)
    file.write(_ply_header(count, degree))


def _ply_header(count: int, degree: int) -> bytes:
    """As long for any count."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    number = str(count)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {'-' * (_COUNT_DIGITS - len(number))}",
        f"element vertex {number}",
        *(f"property float {name}" for name in (*_FIRST, *rest, *_LAST)),
        "end_header",
        "",
    ]
    return "\n".join(header).encode()


def _ply_vertices(baked: BakedGaussians) -> NDArray[np.float32]:
    """One row a Gaussian, in the order of the header."""
    means, scales, quats, opacities, _ = (
        tensor.detach().cpu().numpy() for tensor in baked.gaussians.tensors()
    )
    harmonics = baked.harmonics.cpu().numpy()
    opacities = opacities.clip(1e-6, 1.0 - 1e-6)[:, None]
    columns: list[NDArray] = [
        means,
        np.zeros_like(means),
        harmonics[:, 0],
        harmonics[:, 1:].transpose(0, 2, 1).reshape(len(means), 3 * (harmonics.shape[1] - 1)),
        np.log(opacities / (1.0 - opacities)),
        np.log(scales.clip(1e-9)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True).clip(1e-12),
    ]
    return np.concatenate(columns, axis=1).astype("<f4", copy=False)


def pack_folder(session: Path) -> BinaryIO:
    """The session's folder as an uncompressed tar in a file without a name, at its start.

    It holds the logs and the newest snapshot; what a log grows meanwhile is left out.

    Raises:
        StorageError: the disk refused.
    """
    snapshots = snapshot_folders(session)
    members = [p for p in session.iterdir() if p.is_file() and p.suffix in _PACKED]
    with storage_errors(str(session)):
        file = _nameless(session)
        with tarfile.open(fileobj=file, mode="w") as archive:
            for path in sorted([*members, *snapshots[-1:]]):
                archive.add(path, arcname=f"{session.name}/{path.name}")
        file.seek(0)
    return file


def spooled(write: Callable[[BinaryIO], object], session: Path) -> BinaryIO:
    """A file without a name in the session's folder, with what `write` puts into it.

    Raises:
        StorageError: the disk refused.
    """
    with storage_errors(str(session)):
        file = _nameless(session)
        write(file)
    return file


def _nameless(folder: Path) -> BinaryIO:
    return tempfile.TemporaryFile(dir=folder)
