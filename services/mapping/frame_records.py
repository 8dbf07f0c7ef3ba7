"""All answered frames of a session in columns: 385 bytes a frame, an hour of 30 Hz in 42 MB."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.frames import TrackingStatus
from shared.tracks import FrameRecord

_STATUSES = tuple(TrackingStatus)
_TRIANGLE = np.tril_indices(6)
_ROW = np.dtype(
    [
        ("seq", np.int64),
        ("t_ns", np.int64),
        ("reference_seq", np.int64),
        ("status", np.uint8),
        ("T_reference_camera", np.float64, (3, 4)),
        ("T_world_camera", np.float64, (3, 4)),
        ("covariance", np.float64, (21,)),  # the lower triangle
    ],
)
_FIRST_ROOM = 256


class FrameRecords:
    """Records in order of their seq. The last one is kept as it came."""

    def __init__(self) -> None:
        self._rows = np.empty(0, _ROW)
        self._size = 0
        self.last: FrameRecord | None = None

    def __len__(self) -> int:
        return self._size

    def __contains__(self, seq: int) -> bool:
        seqs = self._rows["seq"][: self._size]
        at = int(np.searchsorted(seqs, seq))
        return at < len(seqs) and int(seqs[at]) == seq

    def append(self, record: FrameRecord) -> None:
        """Add a record whose seq is above all others'; transforms end in the row 0 0 0 1."""
        if self._size == len(self._rows):
            self._rows = np.resize(self._rows, max(_FIRST_ROOM, self._size * 3 // 2))
        self._rows[self._size] = (
            record.seq,
            record.t_ns,
            record.reference_seq,
            _STATUSES.index(record.status),
            record.T_reference_camera[:3],
            record.T_world_camera[:3],
            record.covariance[_TRIANGLE],
        )
        self._size += 1
        self.last = record

    def all(self) -> tuple[FrameRecord, ...]:
        """Every record, in order."""
        return tuple(map(_record, self._rows[: self._size]))


def _record(row: np.void) -> FrameRecord:
    return FrameRecord(
        seq=int(row["seq"]),
        t_ns=int(row["t_ns"]),
        status=_STATUSES[row["status"]],
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
