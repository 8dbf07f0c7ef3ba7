"""The map as files: 3DGS splats (PLY), and the session's folder (tar)."""

from __future__ import annotations

import tarfile
import tempfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from services.mapping.pipeline import Mapper
from services.mapping.rasterizer import Gaussians
from services.mapping.snapshot import snapshot_folders
from services.mapping.storage import storage_errors

SH_DC = 0.28209479177387814  # the constant basis function: colour = 0.5 + SH_DC * f_dc
MIN_OPACITY = 1.0 / 255.0
_PACKED = (".msgpack", ".bin")
_PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def export_ply(mapper: Mapper) -> bytes:
    """The map's Gaussians, each as the keyframe that made its anchor sees it, as a 3DGS PLY.

    Spherical harmonics of degree 0; opacity as a logit, scales as logarithms, quaternions wxyz.
    """
    return ply_bytes(bake(mapper))


@torch.no_grad()
def bake(mapper: Mapper) -> Gaussians:
    """All Gaussians that show, decoded for the views of their anchors' keyframes."""
    creators = mapper.anchors.rows["creator"]
    parts = []
    for seq in creators.unique().tolist():
        index = (creators == seq).nonzero()[:, 0]
        centre = torch.from_numpy(mapper.views[seq].T_world_camera[:3, 3])
        centre = centre.to(mapper.anchors.rows["position"])
        parts.append(mapper.painter.gaussians(index, centre)[1])
    joined = [torch.cat(tensors) for tensors in zip(*(p.tensors() for p in parts), strict=True)]
    if not joined:
        return Gaussians(*(torch.zeros(0, *width) for width in ((3,), (3,), (4,), (), (3,))))
    shows = joined[3] > MIN_OPACITY
    return Gaussians(*(tensor[shows] for tensor in joined))


def ply_bytes(gaussians: Gaussians) -> bytes:
    """Gaussians in the binary PLY that splat viewers read."""
    means, scales, quats, opacities, colours = (
        tensor.detach().cpu().numpy() for tensor in gaussians.tensors()
    )
    opacities = opacities.clip(1e-6, 1.0 - 1e-6)[:, None]
    columns: list[NDArray] = [
        means,
        np.zeros_like(means),
        (colours - 0.5) / SH_DC,
        np.log(opacities / (1.0 - opacities)),
        np.log(scales.clip(1e-9)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True).clip(1e-12),
    ]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(means)}"]
    header += [f"property float {name}" for name in _PROPERTIES]
    text = "\n".join([*header, "end_header", ""])
    return text.encode() + np.concatenate(columns, axis=1).astype("<f4").tobytes()


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


def spooled(content: bytes, session: Path) -> BinaryIO:
    """Bytes in a file without a name in the session's folder.

    Raises:
        StorageError: the disk refused.
    """
    with storage_errors(str(session)):
        file = _nameless(session)
        file.write(content)
    return file


def _nameless(folder: Path) -> BinaryIO:
    return tempfile.TemporaryFile(dir=folder)
