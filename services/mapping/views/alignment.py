"""A keyframe's pose from its colours: a Gauss-Newton step that brings the map's render onto it.

Tracking knows a pose by features and by depth. What is left, of a pixel or less, is in how the
whole image lies on the map (direct alignment, at half size and in grey).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.losses.mapping_loss import MIN_DEPTH_ALPHA, Appearance, Target
from services.mapping.rasterizer import Rendered
from shared.camera import Intrinsics

_BLUR_PX = 1.0  # at half size: gradients reach as far as the images are apart
_BOUND = 3.0  # times the median residual: beyond, a pixel hardly counts
_MEDIAN_STEP = 7  # of the pixels that the median is taken of
_RIDGE = 1e-4  # of the mean diagonal: a wall without texture moves nothing
_MAX_SHIFT_M = 0.05  # an image that asks for more does not show what the map does


Grey = NDArray[np.floating]


class Pair(NamedTuple):
    """A view as the map draws it and as it was seen, in grey at half size."""

    drawn: Grey  # [h, w]
    seen: Grey  # [h, w]
    depth_m: Grey  # [h, w], of what is drawn; 0 where it does not count


@torch.no_grad()
def aligning_twist(
    rendered: Rendered, target: Target, appearance: Appearance
) -> NDArray[np.float64]:
    """The twist [6] of T_camera_world, on the left, that brings a render nearer to its image.

    Zero where they have too little in common to tell.
    """
    half = target.intrinsics.scaled(0.5)
    alpha, gain = _halved(rendered.alpha, half), appearance.exposure[0].cpu().numpy()
    behind = float(appearance.background.cpu().numpy() @ gain) / 3.0
    bias = float(appearance.exposure[1].mean())
    drawn = _halved(rendered.colour, half) @ (gain / 3.0) + (1.0 - alpha) * behind + bias
    seen = _halved(target.colour, half) @ np.full(3, 1.0 / 3.0, np.float32)
    is_known = alpha > MIN_DEPTH_ALPHA
    if target.moving is not None:
        is_known &= _halved(target.moving.float(), half) == 0
    depth_m = _halved(rendered.depth, half) / np.maximum(alpha, MIN_DEPTH_ALPHA) * is_known
    return twist_of(Pair(_blurred(drawn), _blurred(seen), depth_m), half)


def twist_of(pair: Pair, camera: Intrinsics) -> NDArray[np.float64]:
    """The Gauss-Newton step of `aligning_twist`, [6], from images of a camera of their size."""
    known = pair.depth_m > 0
    if not known.any():
        return np.zeros(6)
    residuals = np.abs(pair.drawn - pair.seen)[known][::_MEDIAN_STEP]
    bound = np.float32(_BOUND * np.median(residuals) + 1e-4)
    system = np.zeros((6, 7))
    accumulate(pair, (camera.fx, camera.fy, camera.cx, camera.cy), bound, system)
    hessian = system[:, :6] + np.eye(6) * (_RIDGE * np.trace(system[:, :6]) / 6.0 + 1e-9)
    twist = np.linalg.solve(hessian, system[:, 6])
    return twist if np.linalg.norm(twist[:3]) < _MAX_SHIFT_M else np.zeros(6)


def _halved(image: Tensor, half: Intrinsics) -> NDArray[np.float32]:
    size = half.width, half.height
    small = cv2.resize(image.cpu().numpy(), size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def _blurred(image: Grey) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR_PX), np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def accumulate(pair, camera, bound, system):  # pragma: no cover - compiled
    """Add the normal equations of brightness constancy, [6, 6 + 1]; weights of Geman, McClure.

    A point x of the camera's frame goes to exp(twist) x, and its brightness with it.
    """
    drawn, seen, depth_m = pair
    fx, fy, cx, cy = camera
    row = np.empty(7)
    for v in range(1, drawn.shape[0] - 1):
        for u in range(1, drawn.shape[1] - 1):
            z = depth_m[v, u]
            if z <= 0.0:
                continue
            # The mean gradient of both images: right to the second order in what is between them.
            du = 0.25 * (drawn[v, u + 1] - drawn[v, u - 1] + seen[v, u + 1] - seen[v, u - 1])
            dv = 0.25 * (drawn[v + 1, u] - drawn[v - 1, u] + seen[v + 1, u] - seen[v - 1, u])
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            a, b = du * fx / z, dv * fy / z
            c = -(a * x + b * y) / z
            row[0], row[1], row[2] = a, b, c
            row[3], row[4], row[5] = y * c - z * b, z * a - x * c, x * b - y * a
            row[6] = drawn[v, u] - seen[v, u]
            weight = 1.0 / (1.0 + (row[6] / bound) ** 2) ** 2
            for i in range(6):
                for j in range(7):
                    system[i, j] += weight * row[i] * row[j]
