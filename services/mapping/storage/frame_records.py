"""All answered frames of a session in columns: 385 bytes a frame, an hour of 30 Hz in 42 MB."""

from __future__ import annotations

import numpy as np

from shared.frame_rows import ROW, read_row, write_row
from shared.tracks import FrameRecord

_FIRST_ROOM = 256


class FrameRecords:
    """Records in order of their seq. The last one is kept as it came."""

    def __init__(self) -> None:
        self._rows = np.empty(0, ROW)
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
        write_row(self._rows, self._size, record)
        self._size += 1
        self.last = record

    def all(self) -> tuple[FrameRecord, ...]:
        """Every record, in order."""
        return tuple(map(read_row, self._rows[: self._size]))
