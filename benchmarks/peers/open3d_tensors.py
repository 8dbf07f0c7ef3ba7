"""Arrays as Open3D wants them."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import NDArray


def tensor(values: NDArray) -> o3d.core.Tensor:
    """A tensor with the array's type and shape; the array may change afterwards."""
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values)).clone()


def image(values: NDArray) -> o3d.t.geometry.Image:
    """An image from [H, W, C]."""
    return o3d.t.geometry.Image(tensor(values))
