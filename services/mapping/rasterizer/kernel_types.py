"""Values that kernels share: a camera, arrays of Gaussians, and the layout of their records."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.mapping.rasterizer.scene import ALPHA_MIN, View
from services.mapping.rasterizer.scratch import Scratch
from services.mapping.rasterizer.shuffles import RECORD
from services.mapping.rasterizer.simd import LANES

CHUNK = 4096  # Gaussians in a piece of work; a multiple of LANES
TILE = 32  # side of a tile, pixels

# A record holds 16 float32 (one cache line) per Gaussian. With d the offset from the projected
# mean and [[a, b], [b, c]] the dilated covariance, the exponent is a sum of two squares,
#     d^T cov^-1 d = d_x^2 / a + (a / det) (d_y - (b / a) d_x)^2 ,
# which unlike the usual A d_x^2 + 2 B d_x d_y + C d_y^2 does not cancel for thin ellipses.
# E1 and E2 hold the roots of 1 / a and a / det, times 1/4: kernels want the exponent / 8.
MEAN_X, MEAN_Y = 0, 1
E1, SHEAR, E2 = 2, 3, 4  # SHEAR = b / a
LOG_OPACITY = 5  # ln(opacity) / 8
RED, GREEN, BLUE, DEPTH = 6, 7, 8, 9
HALF_WIDTH, HALF_HEIGHT = 10, 11  # of the ellipse where alpha falls to ALPHA_MIN, pixels
REACH = 12  # the exponent / 8 at that ellipse
SLANT = 13  # b / c: how far right of the mean the ellipse goes per pixel that it goes down

# A gradient record holds the sums over the pixels of a (Gaussian, tile) pair: four for colour and
# depth, then the moments of v = alpha dL/dalpha in the whitened offsets e1, e2.
DEPTH_SUM, MOMENT = 3, 4
MOMENT_1, MOMENT_2, MOMENT_11, MOMENT_12, MOMENT_22 = 5, 6, 7, 8, 9
NUM_SUMS = 10

CUT = np.float32(np.log(ALPHA_MIN) / 8.0)  # ln(ALPHA_MIN) / 8


class Camera(NamedTuple):
    """A view for kernels: float32 numbers, principal point at pixel corners."""

    pose: NDArray[np.float32]  # rows of T_camera_world, [12]
    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    slopes: tuple[np.float32, ...]
    width: int
    height: int

    @staticmethod
    def of(view: View) -> Camera:
        """The kernel's form of a view."""
        k = view.intrinsics
        pose = view.pose().detach().cpu().numpy()[:3].astype(np.float32).reshape(-1)
        fx, fy, cx, cy = (np.float32(x) for x in (k.fx, k.fy, *view.centre_px()))
        slopes = tuple(np.float32(slope) for slope in view.slopes())
        return Camera(pose, fx, fy, cx, cy, slopes, k.width, k.height)

    def tiles(self) -> int:
        """How many tiles cover the image."""
        return -(-self.width // TILE) * -(-self.height // TILE)


class Splats(NamedTuple):
    """The five fields of `Gaussians` as flat float32 arrays."""

    means: NDArray[np.float32]
    scales: NDArray[np.float32]
    quats: NDArray[np.float32]
    opacities: NDArray[np.float32]
    colours: NDArray[np.float32]


class Projected(NamedTuple):
    """Gaussians on the screen; N is their number rounded up to whole vectors."""

    num_gaussians: int
    records: NDArray[np.float32]  # [N * RECORD]
    boxes: NDArray[np.int16]  # first and last tile column, first and last tile row, [4 * N]
    hits: NDArray[np.int32]  # Gaussians of each chunk that hit each tile, [chunks, tiles]
    valid: NDArray[np.uint8]  # per chunk: every input was finite

    @staticmethod
    def empty(count: int, tiles: int, scratch: Scratch) -> Projected:
        """Room for `count` Gaussians."""
        chunks, padded = -(-count // CHUNK), -(-count // LANES) * LANES
        return Projected(
            count,
            scratch.borrow(padded * RECORD),
            scratch.borrow(4 * padded, np.int16),
            scratch.borrow(chunks * tiles, np.int32).reshape(chunks, tiles),
            np.empty(chunks, np.uint8),
        )

    def visible(self) -> NDArray[np.bool_]:
        """Which Gaussians overlap the image, [number of Gaussians]."""
        first, last, *_ = self.boxes.reshape(4, -1)[:, : self.num_gaussians]
        return first <= last


class TileLists(NamedTuple):
    """Which Gaussians touch which tile. A slot is a (Gaussian, tile) pair."""

    first_tile: int  # lists may be of some tiles only, side by side
    tile_starts: NDArray[np.int32]  # bounds of each tile in `keys`, [tiles + 1]
    tile_ends: NDArray[np.int32]  # where the tile was full, [tiles]
    keys: NDArray[np.uint64]  # bits of the depth, then the slot; a tile's are sorted, [M]
    starts: NDArray[np.int32]  # bounds of each Gaussian's slots, [N + 1]
    owners: NDArray[np.int32]  # Gaussian of each slot, [M]


class Tiles(NamedTuple):
    """What the blending of tiles reads: records, lists and the size of the image."""

    records: NDArray[np.float32]
    lists: TileLists
    camera: Camera
