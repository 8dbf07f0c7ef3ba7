"""Exported files fetched piece by piece: the reader sets the pace, and no file waits in RAM."""

from __future__ import annotations

import os
import threading
import uuid
from collections import OrderedDict
from typing import BinaryIO

from shared.errors import NotFoundError
from shared.maps import ExportChunk

MAX_OPEN = 8


class Exports:
    """Open exports by name; the one that was asked for longest ago makes room for a ninth."""

    def __init__(self, piece_bytes: int) -> None:
        self._piece_bytes = piece_bytes
        self._lock = threading.Lock()
        self._open: OrderedDict[str, BinaryIO] = OrderedDict()

    def start(self, file: BinaryIO) -> ExportChunk:
        """Take a file over and give its first piece, with the name to ask for the others by."""
        name = uuid.uuid4().hex
        with self._lock:
            self._open[name] = file
            while len(self._open) > MAX_OPEN:
                self._open.popitem(last=False)[1].close()
            return self._read(name, 0)

    def piece(self, name: str, offset: int) -> ExportChunk:
        """The piece from byte `offset` on; the file is closed with its last one.

        Raises:
            NotFoundError: no such export, or it was closed to make room.
        """
        with self._lock:
            if name not in self._open:
                raise NotFoundError(f"there is no export {name[:40]} under way")
            self._open.move_to_end(name)
            return self._read(name, offset)

    def close(self) -> None:
        """Close what nobody has fetched to its end."""
        with self._lock:
            for file in self._open.values():
                file.close()
            self._open.clear()

    def _read(self, name: str, offset: int) -> ExportChunk:
        file = self._open[name]
        total = file.seek(0, os.SEEK_END)
        file.seek(min(max(offset, 0), total))
        content = file.read(self._piece_bytes)
        if offset + len(content) >= total:
            self._open.pop(name).close()
        return ExportChunk(offset, total, content, name)
