"""A mapper's disk: one folder a session, written so that a crash at any moment leaves it whole."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shared import codec
from shared.camera import Calibration
from shared.errors import InputError, NotFoundError, StorageError

_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,127}")  # a tenant's name before the session's
_RECORD = "session.msgpack"


@dataclass(frozen=True)
class SessionRecord:
    """What a session is, as `session.msgpack` holds it."""

    session: str
    mode: str  # "offline" or "live"
    seed: int
    epoch: int  # grows each time that a process takes the session up
    created_ns: int
    calibration: Calibration
    T_world_first: NDArray[np.float64]  # [4, 4]
    claim: int = 0  # of the gateway that advances the session; grows with every change of it
    log_ends: dict[str, int] = field(default_factory=dict)  # bytes of each older epoch's log


def check_session_name(name: str) -> None:
    """Refuse a name that could leave the data folder.

    Raises:
        InputError: says what a name may be.
    """
    if not _NAME.fullmatch(name):
        allowed = "1 to 128 of letters, digits, '_', '.', '-', not starting with '.'"
        raise InputError("session", f"must be {allowed}, got {name[:80]!r}")


@contextmanager
def storage_errors(what: str) -> Iterator[None]:
    """Turn the disk's refusals (full, read-only) into a StorageError."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{what}: {error.strerror or error}") from error


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file so that a crash leaves the old or the new one."""
    temporary = path.with_name(path.name + ".tmp")
    with storage_errors(str(path)):
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.rename(path)
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make new names in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class SessionFolder:
    """The folder of one session; whoever writes to it holds the session's lease."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with storage_errors(str(path)):
            path.mkdir(parents=True, exist_ok=True)
            sync_folder(path.parent)

    def clear(self) -> None:
        """Remove what a broken removal left: it must not become part of a new session."""
        with storage_errors(str(self.path)):
            for path in self.path.iterdir():
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()

    def take_up(self, epoch: int) -> SessionRecord:
        """The record in its new epoch, on disk already, with the older logs cut at their ends.

        What a frozen owner of an older epoch appends after this was never acknowledged and is
        not part of the session.
        """
        record = read_record(self.path)
        with storage_errors(str(self.path)):
            found = {path.name: path.stat().st_size for path in self.log_paths()}
        record = replace(record, epoch=epoch, log_ends=found | record.log_ends)
        self.write_record(record)
        return record

    def write_record(self, record: SessionRecord) -> None:
        """Replace `session.msgpack`."""
        write_atomically(self.path / _RECORD, codec.pack(record))

    def log_path(self, epoch: int) -> Path:
        """The log that an epoch's owner writes."""
        return self.path / f"log-{epoch:06d}.bin"

    def log_paths(self) -> list[Path]:
        """All logs, oldest first."""
        return sorted(self.path.glob("log-*.bin"))


def has_session(path: Path) -> bool:
    """Whether a folder holds a session."""
    return (path / _RECORD).is_file()


def read_record(path: Path) -> SessionRecord:
    """The record of a session's folder.

    Raises:
        NotFoundError: there is no such session.
        StorageError: its record cannot be read.
    """
    if not has_session(path):
        raise NotFoundError(f"there is no session {path.name}")
    try:
        with storage_errors(str(path)):
            return codec.unpack(SessionRecord, (path / _RECORD).read_bytes())
    except InputError as error:
        raise StorageError(f"{path / _RECORD}: {error}") from None


def remove_session(path: Path) -> None:
    """Remove every byte of a session."""
    with storage_errors(str(path)):
        # The record goes first: what is left of a broken removal is no session any more.
        with contextlib.suppress(FileNotFoundError):
            (path / _RECORD).unlink()
        shutil.rmtree(path)
