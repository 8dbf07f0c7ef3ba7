"""Unit quaternions wxyz as tensors: products, and rotations of vectors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from shared import se3


def quat_wxyz_of(T: se3.Matrix) -> Tensor:
    """The rotation of a transform [4, 4], float32, [4]."""
    x, y, z, w = se3.quat_xyzw_from_rotation(T[:3, :3])
    return torch.from_numpy(np.array([w, x, y, z], np.float32))


def product(first: Tensor, second: Tensor) -> Tensor:
    """Hamilton's product [..., 4]: the rotation `second`, then `first`."""
    a, b, c, d = first.unbind(-1)
    w, x, y, z = second.unbind(-1)
    columns = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    return torch.stack(columns, dim=-1)


def rotate_back(quats: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [..., 3] turned by the inverses of unit quaternions [..., 4]."""
    w, axes = quats[..., :1], quats[..., 1:]
    across = 2.0 * torch.cross(axes, vectors, dim=-1)
    return vectors - w * across + torch.cross(axes, across, dim=-1)
