"""Records of answered frames as rows of an array: 385 bytes each instead of 3 kB of objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.frames import TrackingStatus
from shared.tracks import FrameRecord

STATUSES = tuple(TrackingStatus)
ROW = np.dtype(
    [
        ("seq", np.int64),
        ("t_ns", np.int64),
        ("reference_seq", np.int64),
        ("status", np.uint8),  # a place in STATUSES
        ("T_reference_camera", np.float64, (3, 4)),
        ("T_world_camera", np.float64, (3, 4)),
        ("covariance", np.float64, (21,)),  # the lower triangle
    ],
)
_TRIANGLE = np.tril_indices(6)


def write_row(rows: NDArray[np.void], at: int, record: FrameRecord) -> None:
    """Put a record, whose transforms end in the row 0 0 0 1, into an array of `ROW`."""
    rows[at] = (
        record.seq,
        record.t_ns,
        record.reference_seq,
        STATUSES.index(record.status),
        record.T_reference_camera[:3],
        record.T_world_camera[:3],
        record.covariance[_TRIANGLE],
    )


def read_row(row: np.void) -> FrameRecord:
    """The record of a row."""
    return FrameRecord(
        seq=int(row["seq"]),
        t_ns=int(row["t_ns"]),
        status=STATUSES[row["status"]],
        reference_seq=int(row["reference_seq"]),
        T_reference_camera=_transform(row["T_reference_camera"]),
        T_world_camera=_transform(row["T_world_camera"]),
        covariance=_symmetric(row["covariance"]),
    )


def _transform(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])


def _symmetric(triangle: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.zeros((6, 6))
    matrix[_TRIANGLE] = triangle
    return matrix + np.tril(matrix, -1).T
