"""A session's log: every answered frame, appended before it is acknowledged.

An entry is its length and CRC-32 (4 bytes each, little endian), then a msgpack `Advance`. Entries
survive the death of the process; those of keyframes survive the machine's too (fsync).
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import IO

from services.mapping.storage.folders import storage_errors, sync_folder
from shared import codec
from shared.errors import InputError, StorageError
from shared.tracks import Advance

LOGGER = logging.getLogger(__name__)
_HEAD = struct.Struct("<II")
# How every entry without a keyframe ends: the last field of `Advance`, a name and nothing.
_NO_KEYFRAME = codec.pack({"keyframe": None})[1:]
# And how every entry begins: a map of its fields, and the first one's name.
_FIELDS = fields(Advance)
_FIRST_FIELD = codec.pack(dict.fromkeys(f.name for f in _FIELDS))[: 2 + len(_FIELDS[0].name)]


class SessionLog:
    """One epoch's log, open for appending."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with storage_errors(str(path)):
            self._file = path.open("ab", buffering=0)
            sync_folder(path.parent)

    def append(self, entry: Advance) -> None:
        """Write an entry; when this returns, a keyframe is on the disk.

        Raises:
            StorageError: the disk refused; the log is as it was before.
        """
        payload = codec.pack(entry)
        head = _HEAD.pack(len(payload), zlib.crc32(payload))
        start = self._file.seek(0, os.SEEK_END)
        try:
            with storage_errors(str(self._path)):
                _write_all(self._file, head + payload)
                if entry.keyframe is not None:
                    os.fsync(self._file.fileno())
        except StorageError:
            self._file.truncate(start)
            raise

    def sync(self) -> None:
        """Make every entry so far durable."""
        with storage_errors(str(self._path)):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _write_all(file: IO[bytes], data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def read_log(path: Path, end: int | None = None) -> Iterator[Advance]:
    """The entries of a log, up to byte `end`; leaves out a last one that a crash left torn.

    Raises:
        StorageError: an entry before the last one fails its checksum, or its length is damaged.
    """
    with storage_errors(str(path)), path.open("rb") as file:
        size = _size(file, end)
        while (start := file.tell()) < size:
            payload = _read_payload(file, size)
            if payload is None and not _is_blank(file, size):
                raise StorageError(f"{path}: the entry at byte {start} fails its checksum")
            if payload is None and _is_followed(file, start, size):
                raise StorageError(f"{path}: the entry at byte {start} has a damaged length")
            if payload is None:
                LOGGER.warning("%s: %d bytes at the end are torn", path, size - start)
                return
            yield _decoded(payload, path)


def count_keyframes(path: Path, end: int | None = None) -> int:
    """Keyframes in a log, by the ends of its entries: their images are neither read nor checked."""
    count = 0
    with storage_errors(str(path)), path.open("rb") as file:
        size = _size(file, end)
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            next_entry = file.tell() + _HEAD.unpack(head)[0]
            if next_entry > size or next_entry == file.tell():
                break
            file.seek(max(file.tell(), next_entry - len(_NO_KEYFRAME)))
            count += file.read(next_entry - file.tell()) != _NO_KEYFRAME
    return count


def _decoded(payload: bytes, path: Path) -> Advance:
    try:
        return codec.unpack(Advance, payload)
    except InputError as error:
        raise StorageError(f"{path}: an entry cannot be read ({error})") from None


def _size(file: IO[bytes], end: int | None) -> int:
    """Bytes that belong to a log: those behind `end` were written by an owner that was none."""
    size = os.fstat(file.fileno()).st_size
    return size if end is None else min(size, end)


def _is_blank(file: IO[bytes], size: int) -> bool:
    """Whether nothing but zeros follows: a power cut may lengthen a file before it fills it."""
    while block := file.read(min(1 << 20, max(0, size - file.tell()))):
        if any(block):
            return False
    return True


def _is_followed(file: IO[bytes], start: int, size: int) -> bool:
    """Whether a whole entry lies behind the incomplete one at byte `start`.

    A crash tears the last entry only: then its length is damaged, and entries that were
    acknowledged would be lost with it. All payloads begin with the same bytes.
    """
    file.seek(start + _HEAD.size)
    rest = file.read(max(0, size - file.tell()))
    at = rest.find(_FIRST_FIELD, 1)
    while at > 0:
        length, checksum = _HEAD.unpack(rest[max(0, at - _HEAD.size) : at].rjust(_HEAD.size, b"\0"))
        if 0 < length <= len(rest) - at and zlib.crc32(rest[at : at + length]) == checksum:
            return True
        at = rest.find(_FIRST_FIELD, at + 1)
    return False


def _read_payload(file: IO[bytes], size: int) -> bytes | None:
    """The next payload; None where it is incomplete or fails its checksum."""
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    length, checksum = _HEAD.unpack(head)
    payload = file.read(min(length, max(0, size - file.tell())))
    if length == 0 or len(payload) < length or zlib.crc32(payload) != checksum:
        return None
    return payload
