"""How well a map knows a view: which keyframes saw what it shows, from where and how near.

A pixel is known as well as its best keyframe saw the point behind it: the product of
* whether the keyframe measured the depth where the point lies (else it is hidden, or floats),
* how far apart the two rays are (highlights, and Gaussians that are right from one side only),
* how much nearer the view is than the keyframe was (detail that no keyframe had),
and of the square of the view's alpha. Then the least of a pixel's surroundings counts: errors sit
at the borders of what was seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from services.mapping.anchors.carving import nearest_around
from services.mapping.rasterizer import View
from services.mapping.views.overlap import share_inside
from services.mapping.views.training_views import TrainingView
from shared import se3
from shared.camera import Calibration, Intrinsics
from shared.rectify import RgbdImage

ANGLE_DEG = 20.0  # between the rays; as a standard deviation
DEPTH_TOLERANCE_M = 0.007  # between the point and the measured surface; as a standard deviation
DEPTH_TOLERANCE = 0.01  # of the depth, added
UNMEASURED = 0.5  # the agreement with a pixel that has no depth
MAX_KEYFRAMES = 16  # that are looked at for every pixel
MAX_FACING = 64  # that are asked what they look through
_COARSE_PX = 160  # width at which this is computed
_PROBE_STRIDE = 12  # of coarse pixels, when keyframes are chosen
_MILLIMETRES = 1000.0
_HIDDEN_MM = 1  # what is behind something that moves is as if behind a hand on the lens


class DrawnView(Protocol):
    """What is asked about."""

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """[H, W], 0 where nothing is drawn."""
        ...

    @property
    def alpha(self) -> NDArray[np.uint8]:
        """[H, W]."""
        ...


@dataclass(frozen=True)
class _Points:
    """Surface points of a view, on a grid of its pixels."""

    world: NDArray[np.float64]  # [P, 3]
    is_drawn: NDArray[np.bool_]  # [P]
    camera_world: NDArray[np.float64]  # [3]

    def every(self, index: NDArray[np.int64]) -> _Points:
        return _Points(self.world[index], self.is_drawn[index], self.camera_world)


class CoarseDepths(NamedTuple):
    """What keyframes measured, as kernels want it."""

    T_camera_world: NDArray[np.float64]  # [K, 3, 4]
    depths_mm: NDArray[np.uint16]  # [K, h, w]
    camera: NDArray[np.float64]  # fx, fy, cx, cy of the whole image, then its pixels per coarse one


class Sightings:
    """The depth that every keyframe measured, coarsely (38 kB a keyframe of 640x480)."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._depths_mm: dict[int, NDArray[np.uint16]] = {}
        self._step = 1
        self.camera = calibration.colour.intrinsics  # of the keyframes' rectified images

    def add(self, seq: int, image: RgbdImage) -> None:
        """Keep what a keyframe measured."""
        self.camera = image.intrinsics
        self._step = _step_of(image.intrinsics)
        coarse_m = _coarse_depth(image.depth_m, self._step)
        depth_mm = np.clip(coarse_m * _MILLIMETRES, 0, 65535).astype(np.uint16)
        if image.moving is not None:
            depth_mm[image.moving[_grid(self._step)]] = _HIDDEN_MM
        self._depths_mm[seq] = depth_mm

    def confidence(
        self, drawn: DrawnView, view: View, keyframes: list[TrainingView]
    ) -> NDArray[np.uint8]:
        """How well each pixel of a drawn view is known, 0 to 255, [H, W].

        Args:
            keyframes: all of the map, with their present poses.
        """
        height, width = drawn.alpha.shape
        step = _step_of(view.intrinsics)
        depth_m = drawn.depth_m[_grid(step)]
        if not keyframes or not depth_m.any():
            return np.zeros((height, width), np.uint8)
        points = _surface_points(depth_m, view, step)
        chosen = self._best_keyframes(points, depth_m.shape, keyframes)
        seen = self._weights(points, chosen).max(axis=0).reshape(depth_m.shape)
        least = cv2.erode(seen, np.ones((3, 3), np.uint8))
        smooth = cv2.resize(least, (width, height), interpolation=cv2.INTER_LINEAR)
        alpha = drawn.alpha.astype(np.float32) / np.float32(255.0)
        return np.rint(255.0 * alpha * alpha * smooth).astype(np.uint8)

    def agreement(
        self, points_world: NDArray[np.float32], keyframe: TrainingView
    ) -> NDArray[np.float32]:
        """Whether a keyframe measured a surface at points [P, 3] that it looks at, 0 to 1, [P]."""
        is_drawn, centre = np.ones(len(points_world), bool), keyframe.T_world_camera[:3, 3]
        points = _Points(points_world.astype(np.float64), is_drawn, centre.copy())
        return self._weights(points, [keyframe])[0]

    def facing(
        self, points_world: NDArray[np.float64], keyframes: list[TrainingView]
    ) -> list[TrainingView]:
        """Of the keyframes, the `MAX_FACING` that have most of the points [P, 3] in their image."""
        if len(keyframes) <= MAX_FACING:
            return keyframes
        shares = [share_inside(points_world, k.T_world_camera, self.camera) for k in keyframes]
        best = np.argsort(-np.array(shares), kind="stable")[:MAX_FACING]
        return [keyframes[i] for i in sorted(best.tolist())]

    def coarse_depths(self, keyframes: list[TrainingView]) -> CoarseDepths:
        """What keyframes measured, one or more."""
        T = np.stack([se3.inverse(keyframe.T_world_camera)[:3] for keyframe in keyframes])
        k = self.camera
        depths = np.stack([self._depth_mm(keyframe) for keyframe in keyframes])
        return CoarseDepths(T, depths, np.array([k.fx, k.fy, k.cx, k.cy, self._step], np.float64))

    def _best_keyframes(
        self, points: _Points, shape: tuple[int, ...], keyframes: list[TrainingView]
    ) -> list[TrainingView]:
        """Those that know most of a sparse grid of the points."""
        if len(keyframes) <= MAX_KEYFRAMES:
            return keyframes
        first = min(_PROBE_STRIDE // 2, min(shape) - 1)
        rows, columns = (np.arange(first, side, _PROBE_STRIDE) for side in shape)
        probes = points.every((rows[:, None] * shape[1] + columns).ravel())
        known = self._weights(probes, keyframes).sum(axis=1)
        best = np.argsort(-known, kind="stable")[:MAX_KEYFRAMES]
        return [keyframes[i] for i in sorted(best.tolist())]

    def _weights(self, points: _Points, keyframes: list[TrainingView]) -> NDArray[np.float32]:
        """How well each keyframe saw each point, 0 to 1, [K, P]."""
        weights = np.zeros((len(keyframes), len(points.world)), np.float32)
        drawn = points.world, points.is_drawn, points.camera_world
        weigh(drawn, self.coarse_depths(keyframes), weights)
        return weights

    def _depth_mm(self, keyframe: TrainingView) -> NDArray[np.uint16]:
        """A keyframe's depth; decoded anew after the session was taken up again."""
        if keyframe.seq not in self._depths_mm:
            self.add(keyframe.seq, keyframe.image(self._calibration))
        return self._depths_mm[keyframe.seq]


def _step_of(intrinsics: Intrinsics) -> int:
    return max(1, round(intrinsics.width / _COARSE_PX))


def _grid(step: int) -> tuple[slice, slice]:
    """The pixels that stand for all."""
    return slice(step // 2, None, step), slice(step // 2, None, step)


def _coarse_depth(depth_m: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """The readings on the grid; where one is missing, the nearest surface of its cell.

    Sensors that project a pattern leave single pixels out all over a surface.
    """
    sampled = depth_m[_grid(step)]
    if sampled.all():
        return sampled
    nearest = nearest_around(depth_m, max(3, step | 1))[_grid(step)]
    return np.where(sampled > 0, sampled, nearest)


def _surface_points(depth_m: NDArray[np.float32], view: View, step: int) -> _Points:
    T_world_camera = se3.inverse(np.asarray(view.T_camera_world))
    k, (height, width) = view.intrinsics, depth_m.shape
    x = (np.arange(width) * step + step // 2 - k.cx) / k.fx
    y = (np.arange(height) * step + step // 2 - k.cy) / k.fy
    rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)
    camera = (rays * depth_m[..., None]).reshape(-1, 3)
    world = se3.transform(T_world_camera, camera)
    return _Points(world, depth_m.ravel() > 0, T_world_camera[:3, 3].copy())


_TWO_VARIANCES = 2.0 * math.radians(ANGLE_DEG) ** 2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def weigh(points, keyframes, weights):  # pragma: no cover - compiled
    """`weights` [K, P] of points (world [P, 3], drawn [P], camera [3]) in keyframes.

    Keyframes are `CoarseDepths`.
    """
    world, is_drawn, eye = points
    T, depths, camera = keyframes
    fx, fy, cx, cy, step = camera
    half = step // 2
    for i in range(T.shape[0]):
        R, t, depth = T[i, :, :3], T[i, :, 3], depths[i]
        for p in range(world.shape[0]):
            x, y, z = world[p]
            zc = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
            if not is_drawn[p] or zc < 0.05:
                continue
            xc = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
            yc = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
            column = int(np.floor((fx * xc / zc + cx - half) / step + 0.5))
            row = int(np.floor((fy * yc / zc + cy - half) / step + 0.5))
            if row < 0 or column < 0 or row >= depth.shape[0] or column >= depth.shape[1]:
                continue
            agreement = UNMEASURED
            if depth[row, column] > 0:
                gap = zc - depth[row, column] / _MILLIMETRES
                gap /= DEPTH_TOLERANCE_M + DEPTH_TOLERANCE * zc
                agreement = np.exp(-0.5 * gap * gap)
            # The keyframe's ray to the point, in its own camera, and the view's, in the world.
            vx, vy, vz = x - eye[0], y - eye[1], z - eye[2]
            ex = R[0, 0] * vx + R[0, 1] * vy + R[0, 2] * vz
            ey = R[1, 0] * vx + R[1, 1] * vy + R[1, 2] * vz
            ez = R[2, 0] * vx + R[2, 1] * vy + R[2, 2] * vz
            near = np.sqrt(vx * vx + vy * vy + vz * vz)
            far = np.sqrt(xc * xc + yc * yc + zc * zc)
            cosine = (ex * xc + ey * yc + ez * zc) / max(near * far, 1e-9)
            angle = np.arccos(min(max(cosine, -1.0), 1.0))
            detail = min(1.0, near / far)
            weights[i, p] = agreement * detail * np.exp(-angle * angle / _TWO_VARIANCES)
