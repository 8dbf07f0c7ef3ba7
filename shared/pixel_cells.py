"""A mask of pixels as coarse cells: small enough to send and to log with every keyframe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CELL_PX = 8


def cells_of(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells of CELL_PX x CELL_PX pixels that hold some of a mask [H, W], [H / 8, W / 8]."""
    height, width = mask.shape
    padded = np.pad(mask, ((0, -height % CELL_PX), (0, -width % CELL_PX)))
    rows, columns = padded.shape[0] // CELL_PX, padded.shape[1] // CELL_PX
    return np.asarray(padded.reshape(rows, CELL_PX, columns, CELL_PX).any(axis=(1, 3)))


def pixels_of(cells: NDArray[np.bool_], height: int, width: int) -> NDArray[np.bool_]:
    """The pixels in cells of `cells_of`, [height, width]; none where cells are lacking."""
    mask = cells.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)[:height, :width]
    return np.pad(mask, ((0, height - mask.shape[0]), (0, width - mask.shape[1])))
