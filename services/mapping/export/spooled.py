"""Files without a name that exports are read from, and the session's folder as one (tar)."""

from __future__ import annotations

import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from services.mapping.storage.folders import storage_errors
from services.mapping.storage.snapshot import snapshot_folders

_PACKED = (".msgpack", ".bin")


def pack_folder(session: Path) -> BinaryIO:
    """The session's folder as an uncompressed tar in a file without a name, at its start.

    It holds the logs and the newest snapshot; what a log grows meanwhile is left out.

    Raises:
        StorageError: the disk refused.
    """
    snapshots = snapshot_folders(session)
    members = [p for p in session.iterdir() if p.is_file() and p.suffix in _PACKED]
    with storage_errors(str(session)):
        file = _nameless(session)
        with tarfile.open(fileobj=file, mode="w") as archive:
            for path in sorted([*members, *snapshots[-1:]]):
                archive.add(path, arcname=f"{session.name}/{path.name}")
        file.seek(0)
    return file


def spooled(write: Callable[[BinaryIO], object], session: Path) -> BinaryIO:
    """A file without a name in the session's folder, with what `write` puts into it.

    Raises:
        StorageError: the disk refused.
    """
    with storage_errors(str(session)):
        file = _nameless(session)
        write(file)
    return file


def _nameless(folder: Path) -> BinaryIO:
    return tempfile.TemporaryFile(dir=folder)
