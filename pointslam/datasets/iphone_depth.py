"""ScanNet++'s `iphone/depth.bin`: all depth images of a recording, 256x192, in one file.

Two layouts are published. One raw deflate stream (no zlib header) of float32 metres [F, 192, 256];
or, for each frame, its size as a little-endian uint32 and so many bytes, which are uint16
millimetres as an LZ4 block or float32 metres as raw deflate.
"""

from __future__ import annotations

import importlib
import struct
import threading
import zlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shared.errors import SequenceError

WIDTH, HEIGHT = 256, 192
_PIXELS = WIDTH * HEIGHT
_FLOAT_BYTES, _MILLIMETRE_BYTES = 4 * _PIXELS, 2 * _PIXELS
_CHUNK = 1 << 16
_BOOKMARK_EVERY = 32  # frames; a bookmark is zlib's window, some 40 kB


class DepthFile(Protocol):
    """Depth images by number."""

    def __len__(self) -> int: ...

    def frame_mm(self, number: int) -> NDArray[np.uint16]:
        """Millimetres, [192, 256], 0 where there is none; SequenceError when damaged."""
        ...


def open_depth(path: Path) -> DepthFile:
    """Open a `depth.bin` of either layout.

    Raises:
        SequenceError: it cannot be read, is damaged, or is of neither layout.
    """
    try:
        data = np.memmap(path, np.uint8, "r").data
    except (OSError, ValueError) as error:
        raise SequenceError(path, f"cannot be read ({error})") from None
    spans = _spans(data)
    return _DeflateStream(path, data) if spans is None else _SizedFrames(path, data, spans)


def _spans(data: memoryview) -> list[tuple[int, int]] | None:
    """Start and end of each sized frame; None unless the sizes lead to the end exactly."""
    spans, at = [], 0
    while at + 4 <= len(data):
        (size,) = struct.unpack_from("<I", data, at)
        if size == 0:
            return None
        spans.append((at + 4, at + 4 + size))
        at += 4 + size
    return spans if at == len(data) else None


def _millimetres(data: bytes) -> NDArray[np.uint16]:
    depth_mm = np.frombuffer(data, "<f4").reshape(HEIGHT, WIDTH) * 1000.0
    is_reading = (depth_mm > 0.0) & (depth_mm < 65535.0)  # false for NaN too
    return np.where(is_reading, np.rint(np.where(is_reading, depth_mm, 0.0)), 0).astype(np.uint16)


class _SizedFrames:
    def __init__(self, path: Path, data: memoryview, spans: list[tuple[int, int]]) -> None:
        self._path, self._data, self._spans = path, data, spans

    def __len__(self) -> int:
        return len(self._spans)

    def frame_mm(self, number: int) -> NDArray[np.uint16]:
        start, end = self._spans[number]
        packed = bytes(self._data[start:end])
        floats = _inflate(packed)
        if floats is not None:
            return _millimetres(floats)
        return np.frombuffer(self._unpack_lz4(packed, number), "<u2").reshape(HEIGHT, WIDTH)

    def _unpack_lz4(self, packed: bytes, number: int) -> bytes:
        block = _lz4_block(self._path)
        try:
            unpacked = block.decompress(packed, uncompressed_size=_MILLIMETRE_BYTES)
        except block.LZ4BlockError:
            unpacked = b""
        if len(unpacked) != _MILLIMETRE_BYTES:
            raise SequenceError(self._path, f"frame {number} is damaged")
        return unpacked


def _inflate(packed: bytes) -> bytes | None:
    """A frame of raw deflate; None where it is something else, which is LZ4 then."""
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        floats = inflater.decompress(packed, _FLOAT_BYTES + 1)
    except zlib.error:
        return None
    return floats if inflater.eof and len(floats) == _FLOAT_BYTES else None


def _lz4_block(path: Path) -> Any:
    try:
        return importlib.import_module("lz4.block")
    except ImportError:
        raise SequenceError(path, "is packed with LZ4: pip install lz4") from None


class _Reader:
    """A place in a deflate stream."""

    def __init__(self, data: memoryview, inflater: Any, at: int) -> None:
        self._data, self._inflater, self._at = data, inflater, at

    def copy(self) -> _Reader:
        """The same place, kept while this one goes on."""
        return _Reader(self._data, self._inflater.copy(), self._at)

    def read(self) -> bytes:
        """The next frame, shorter where the stream ends; zlib.error where it is damaged."""
        parts, missing = [], _FLOAT_BYTES
        while missing and not self._inflater.eof:
            chunk = self._data[self._at : self._at + _CHUNK]
            part = self._inflater.decompress(chunk, missing)
            self._at += len(chunk) - len(self._inflater.unconsumed_tail)
            if not part and not chunk:
                break
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)


class _DeflateStream:
    """Inflated once when it is opened, to count its frames and to leave bookmarks."""

    def __init__(self, path: Path, data: memoryview) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._bookmarks: list[_Reader] = []
        self._reader = _Reader(data, zlib.decompressobj(-zlib.MAX_WBITS), 0)
        self._next = 0
        self._length = self._count()

    def __len__(self) -> int:
        return self._length

    def frame_mm(self, number: int) -> NDArray[np.uint16]:
        with self._lock:
            page = number // _BOOKMARK_EVERY
            if not page * _BOOKMARK_EVERY <= self._next <= number:
                self._reader = self._bookmarks[page].copy()
                self._next = page * _BOOKMARK_EVERY
            for _ in range(self._next, number):
                self._reader.read()
            self._next = number + 1
            return _millimetres(self._reader.read())

    def _count(self) -> int:
        count = 0
        try:
            while True:
                if count % _BOOKMARK_EVERY == 0:
                    self._bookmarks.append(self._reader.copy())
                size = len(self._reader.read())
                if size == 0:
                    break
                if size < _FLOAT_BYTES:
                    raise SequenceError(self._path, f"ends within frame {count}")
                count += 1
        except zlib.error:
            reason = f"is of neither published layout, or is damaged at frame {count}"
            raise SequenceError(self._path, reason) from None
        self._next = count  # so the first frame asked for starts at a bookmark
        return count
