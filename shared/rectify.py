"""From an encoded frame to what the algorithms want: a pinhole image with registered depth.

Undistorts colour, and warps depth of a separate camera into the colour camera. Tracking, mapping
and evaluation all use this one, so that they see the same pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import ColourImage, DepthImage, Frame
from shared.images import decode_colour, decode_depth


@dataclass(frozen=True)
class RgbdImage:
    """Colour and registered depth in one ideal pinhole camera."""

    rgb: NDArray[np.uint8]  # [H, W, 3]
    depth_m: NDArray[np.float32]  # [H, W], 0 where there is none
    intrinsics: Intrinsics
    moving: NDArray[np.bool_] | None = None  # [H, W], pixels that are not to be looked at

    def without(self, moving: NDArray[np.bool_]) -> RgbdImage:
        """The image with no depth, and colours that do not count, at some pixels [H, W]."""
        return replace(self, depth_m=np.where(moving, np.float32(0.0), self.depth_m), moving=moving)

    def mean_colour(self) -> NDArray[np.floating]:
        """Mean of the colours that count, 0 to 255, [3]; zero where none does."""
        counted = None if self.moving is None else (~self.moving).astype(np.uint8)
        return np.array(cv2.mean(self.rgb, counted)[:3])


def rectify(frame: Frame, calibration: Calibration) -> RgbdImage:
    """Decode a frame, undistort it and register its depth to colour.

    Raises:
        InputError: an image is damaged or has another size than the calibration says.
    """
    rgb = rectify_colour(frame.rgb, calibration)
    depth_m = rectify_depth(frame.depth, calibration)
    return RgbdImage(rgb, depth_m, calibration.colour.intrinsics)


def rectify_colour(image: ColourImage, calibration: Calibration) -> NDArray[np.uint8]:
    """Decode a colour image and undistort it, [H, W, 3].

    Raises:
        InputError: as `rectify`.
    """
    camera = calibration.colour
    return _undistort(decode_colour(image, camera.intrinsics), camera, cv2.INTER_LINEAR)


def rectify_depth(image: DepthImage, calibration: Calibration) -> NDArray[np.float32]:
    """Decode a depth image, undistort it and register it to colour, metres, [H, W].

    Raises:
        InputError: as `rectify`.
    """
    return _registered(decode_depth(image, calibration), calibration)


def rectify_images(
    rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], calibration: Calibration
) -> RgbdImage:
    """`rectify` for images that are decoded already; depth is of the depth camera, metres."""
    colour = calibration.colour
    rgb = _undistort(rgb, colour, cv2.INTER_LINEAR)
    return RgbdImage(rgb, _registered(depth_m, calibration), colour.intrinsics)


def _registered(depth_m: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float32]:
    colour, depth = calibration.colour, calibration.depth
    if depth is None:  # registered by the device: to the distorted colour image
        return _undistort(depth_m, colour, cv2.INTER_NEAREST)
    return register_depth(
        _undistort(depth_m, depth, cv2.INTER_NEAREST),
        depth.intrinsics,
        colour.intrinsics,
        calibration.T_colour_depth,
    )


def register_depth(
    depth_m: NDArray[np.float32],
    depth_intrinsics: Intrinsics,
    colour_intrinsics: Intrinsics,
    T_colour_depth: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Depth of one camera as another sees it; the nearest surface wins.

    Args:
        depth_m: [Hd, Wd], metres, 0 where there is none.
        depth_intrinsics, colour_intrinsics: pinholes of the source and of the target.
        T_colour_depth: points of the depth camera to the colour camera, [4, 4].

    Returns:
        depth in the colour camera, metres, [Hc, Wc]. Each reading fills the pixels that its own
        pixel covers there, so that a finer target has no grid of holes.
    """
    d, c = depth_intrinsics, colour_intrinsics
    out = np.zeros((c.height, c.width), np.float32)
    _splat_depth(
        depth_m,
        np.array([d.fx, d.fy, d.cx, d.cy]),
        np.array([c.fx, c.fy, c.cx, c.cy]),
        T_colour_depth,
        out,
    )
    return out


@numba.njit(cache=True, nogil=True)
def _splat_depth(depth, source, target, T, out):  # pragma: no cover - compiled
    height, width = out.shape
    half_u = 0.5 * target[0] / source[0]
    half_v = 0.5 * target[1] / source[1]
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if not z > 0.0:
                continue
            x = (column - source[2]) / source[0] * z
            y = (row - source[3]) / source[1] * z
            zc = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if zc <= 0.0:
                continue
            u = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / zc * target[0] + target[2]
            v = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / zc * target[1] + target[3]
            ratio = z / zc
            # Pixels whose centre lies under the footprint; at least the nearest one.
            u0 = int(np.floor(u - half_u * ratio + 1.0))
            u1 = int(np.floor(u + half_u * ratio))
            v0 = int(np.floor(v - half_v * ratio + 1.0))
            v1 = int(np.floor(v + half_v * ratio))
            if u1 < u0:
                u0 = u1 = int(np.floor(u + 0.5))
            if v1 < v0:
                v0 = v1 = int(np.floor(v + 0.5))
            for vv in range(max(v0, 0), min(v1, height - 1) + 1):
                for uu in range(max(u0, 0), min(u1, width - 1) + 1):
                    if out[vv, uu] == 0.0 or zc < out[vv, uu]:
                        out[vv, uu] = zc


@lru_cache(maxsize=16)
def _undistortion_maps(camera: Camera) -> tuple[NDArray, NDArray]:
    i = camera.intrinsics
    matrix, size = i.matrix(), (i.width, i.height)
    coefficients = np.array(camera.distortion)
    if camera.fisheye:
        return cv2.fisheye.initUndistortRectifyMap(
            matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1
        )
    return cv2.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)


def _undistort(image: NDArray, camera: Camera, interpolation: int) -> NDArray:
    if not any(camera.distortion):
        return image
    map_x, map_y = _undistortion_maps(camera)
    return cv2.remap(image, map_x, map_y, interpolation, borderMode=cv2.BORDER_CONSTANT)
