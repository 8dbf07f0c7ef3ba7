"""Snapshots of a session: the map and the keyframe store, and how far into the log they reach.

A folder `snapshot-<n>` holds safetensors and JSON, and a manifest with the checksum of each file.
It gets its name only when all is on the disk; the newest two are kept.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy
import safetensors.torch

from services.mapping.map_state import MapState
from services.mapping.storage.folders import storage_errors, sync_folder
from shared import codec
from shared.errors import InputError, StorageError
from shared.maps import JobStatus

LOGGER = logging.getLogger(__name__)
_KEPT = 2
_MAP, _KEYFRAMES, _VALUES, _MANIFEST = (
    "map.safetensors",
    "keyframes.safetensors",
    "values.json",
    "manifest.json",
)
# Damaged, or written by a version that knew more: an older one, or the log, is read instead.
_UNREADABLE = (OSError, ValueError, KeyError, safetensors.SafetensorError, InputError)


@dataclass(frozen=True)
class Snapshot:
    """A session as it was after `entries` log entries."""

    entries: int
    map: MapState
    keyframes: Mapping[str, np.ndarray]  # of the KeyframeStore
    refinement: JobStatus = JobStatus()  # how far it was when the map was so


def write_snapshot(
    session: Path, snapshot: Snapshot, check_owner: Callable[[], None] = lambda: None
) -> int:
    """Write a snapshot and remove all but the newest two; returns its size in bytes.

    `check_owner` is called before the snapshot gets its name; what it raises leaves none.

    Raises:
        StorageError: the disk refused; older snapshots are as they were.
    """
    numbers = [_number(folder) for folder in snapshot_folders(session)]
    final = session / f"snapshot-{max(numbers, default=0) + 1:06d}"
    temporary = final.with_suffix(".tmp")
    with storage_errors(str(final)):
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        try:
            size = _write_files(temporary, snapshot)
        except (OSError, safetensors.SafetensorError) as error:
            shutil.rmtree(temporary, ignore_errors=True)
            raise StorageError(f"{final}: {error}") from error
        check_owner()
        temporary.rename(final)
        sync_folder(session)
    for folder in snapshot_folders(session)[:-_KEPT]:
        shutil.rmtree(folder, ignore_errors=True)
    return size


def read_newest(session: Path) -> Snapshot | None:
    """The newest snapshot whose checksums hold; None when there is none."""
    for folder in reversed(snapshot_folders(session)):
        try:
            return _read(folder)
        except _UNREADABLE as error:
            LOGGER.warning("%s: passed over (%s: %s)", folder, type(error).__name__, error)
    return None


def snapshot_folders(session: Path) -> list[Path]:
    """Folders of whole snapshots, oldest first."""
    found = [p for p in session.glob("snapshot-*") if p.suffix != ".tmp" and p.is_dir()]
    return sorted(found, key=_number)


def _number(folder: Path) -> int:
    digits = folder.name.removeprefix("snapshot-")
    return int(digits) if digits.isdecimal() else 0


def _write_files(folder: Path, snapshot: Snapshot) -> int:
    safetensors.torch.save_file(snapshot.map.tensors, folder / _MAP)
    keyframes = {name: np.ascontiguousarray(a) for name, a in snapshot.keyframes.items()}
    safetensors.numpy.save_file(keyframes, folder / _KEYFRAMES)
    values = {"entries": snapshot.entries, "map": snapshot.map.values}
    values["refinement"] = codec.to_json(snapshot.refinement)
    (folder / _VALUES).write_text(json.dumps(values))
    checksums = {name: _checksum(folder / name) for name in (_MAP, _KEYFRAMES, _VALUES)}
    (folder / _MANIFEST).write_text(json.dumps(checksums))
    for path in folder.iterdir():
        with path.open("rb") as file:
            os.fsync(file.fileno())
    sync_folder(folder)
    return sum(path.stat().st_size for path in folder.iterdir())


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read(folder: Path) -> Snapshot:
    for name, checksum in json.loads((folder / _MANIFEST).read_text()).items():
        if _checksum(folder / name) != checksum:
            raise ValueError(f"{name} fails its checksum")
    values = json.loads((folder / _VALUES).read_text())
    return Snapshot(
        entries=values["entries"],
        map=MapState(safetensors.torch.load_file(folder / _MAP), values["map"]),
        keyframes=safetensors.numpy.load_file(folder / _KEYFRAMES),
        refinement=codec.from_plain(JobStatus, values["refinement"]),
    )
