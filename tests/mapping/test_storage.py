"""The disk: torn logs, damaged snapshots, names, a full disk."""

from __future__ import annotations

import hashlib
import json
import resource
import signal

import numpy as np
import pytest
import torch

from services.mapping.map_state import MapState
from services.mapping.storage.folders import SessionFolder, check_session_name, write_atomically
from services.mapping.storage.log import SessionLog, count_keyframes, read_log
from services.mapping.storage.snapshot import Snapshot, read_newest, write_snapshot
from shared.errors import InputError, StorageError


@pytest.fixture
def written(tmp_path, entry):
    path = tmp_path / "log-000001.bin"
    log = SessionLog(path)
    for seq in range(5):
        log.append(entry(seq))
    log.close()
    return path


def snapshot(value: float) -> Snapshot:
    tensors = {"anchors.position": torch.full((4, 3), value)}
    values = {"generator": {"state": 2**100 + int(value)}}
    return Snapshot(int(value), MapState(tensors, values), {"seqs": np.arange(3)})


def test_a_log_gives_back_what_was_appended(written, entry):
    entries = list(read_log(written))

    assert [e.record.seq for e in entries] == [0, 1, 2, 3, 4]
    assert entries[4].frame == entry(4).frame
    assert entries[0].keyframe is not None
    np.testing.assert_array_equal(
        entries[0].keyframe.cloud_camera.points, entry(0).keyframe.cloud_camera.points
    )


@pytest.mark.parametrize("lost_bytes", [1, 100, 1000])
def test_a_torn_last_entry_is_left_out(written, lost_bytes):
    written.write_bytes(written.read_bytes()[:-lost_bytes])

    entries = list(read_log(written))

    assert [e.record.seq for e in entries] == [0, 1, 2, 3]


def test_a_head_without_its_entry_is_left_out(written):
    with written.open("ab") as file:
        file.write(b"\x10\x00\x00")

    assert len(list(read_log(written))) == 5


def test_keyframes_are_counted_without_reading_them(written):
    assert count_keyframes(written) == 2  # 0 and 4


def test_zeros_that_a_power_cut_left_at_the_end_are_left_out(written):
    keyframes = count_keyframes(written)
    with written.open("ab") as file:
        file.write(bytes(1000))

    assert len(list(read_log(written))) == 5
    assert count_keyframes(written) == keyframes


def test_a_torn_keyframe_does_not_count(written):
    written.write_bytes(written.read_bytes()[:-1])

    assert count_keyframes(written) == 1


def test_what_a_broken_removal_left_can_be_cleared(written):
    write_snapshot(written.parent, snapshot(1.0))
    folder = SessionFolder(written.parent)

    folder.clear()

    assert list(written.parent.iterdir()) == []


def test_a_log_is_read_up_to_the_end_that_its_next_owner_found(written):
    end = written.stat().st_size
    log = SessionLog(written)
    log.append(next(read_log(written)))
    log.close()

    assert len(list(read_log(written, end))) == 5
    assert count_keyframes(written, end) == 2


def test_damage_before_the_last_entry_is_an_error(written):
    data = bytearray(written.read_bytes())
    data[50] ^= 0xFF
    written.write_bytes(data)

    with pytest.raises(StorageError, match="checksum"):
        list(read_log(written))


@pytest.mark.parametrize("length", [b"\xff\xff\xff\x7f", b"\x01\x00\x00\x00"])
def test_a_damaged_length_before_the_last_entry_is_an_error_and_no_torn_end(written, length):
    data = bytearray(written.read_bytes())
    second = 8 + int.from_bytes(data[:4], "little")
    data[second : second + 4] = length
    written.write_bytes(data)

    with pytest.raises(StorageError, match=f"byte {second}"):
        list(read_log(written))


def test_a_full_disk_is_a_storage_error_and_leaves_the_log_whole(written, entry):
    log = SessionLog(written)
    size = written.stat().st_size
    # The kernel refuses to let files of this process grow, as a full disk would.
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, limits[1]))
    try:
        with pytest.raises(StorageError):
            log.append(entry(8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    assert written.stat().st_size == size
    log.append(entry(8))
    assert [e.record.seq for e in read_log(written)][-1] == 8


def test_the_newest_snapshot_is_read_back(tmp_path):
    for value in (1.0, 2.0, 3.0):
        write_snapshot(tmp_path, snapshot(value))

    found = read_newest(tmp_path)

    assert found is not None
    assert found.entries == 3
    assert found.map.values["generator"]["state"] == 2**100 + 3
    assert torch.equal(found.map.tensors["anchors.position"], torch.full((4, 3), 3.0))
    np.testing.assert_array_equal(found.keyframes["seqs"], np.arange(3))


def test_two_snapshots_are_kept(tmp_path):
    for value in (1.0, 2.0, 3.0):
        write_snapshot(tmp_path, snapshot(value))

    assert len(list(tmp_path.glob("snapshot-*"))) == 2


def test_a_damaged_snapshot_is_passed_over_for_the_one_before(tmp_path):
    for value in (1.0, 2.0):
        write_snapshot(tmp_path, snapshot(value))
    damaged = tmp_path / "snapshot-000002" / "map.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-8] + b"damaged!")

    found = read_newest(tmp_path)
    assert found is not None
    assert found.entries == 1


def test_a_snapshot_of_a_version_that_knew_more_is_passed_over(tmp_path):
    for value in (1.0, 2.0):
        write_snapshot(tmp_path, snapshot(value))
    newest = tmp_path / "snapshot-000002"
    values = json.loads((newest / "values.json").read_text())
    values["refinement"]["of_tomorrow"] = 1
    (newest / "values.json").write_text(json.dumps(values))
    checksums = json.loads((newest / "manifest.json").read_text())
    digest = hashlib.sha256((newest / "values.json").read_bytes()).hexdigest()
    (newest / "manifest.json").write_text(json.dumps(checksums | {"values.json": digest}))

    found = read_newest(tmp_path)

    assert found is not None
    assert found.entries == 1


def test_a_snapshot_that_was_not_finished_does_not_count(tmp_path):
    write_snapshot(tmp_path, snapshot(1.0))
    (tmp_path / "snapshot-000001").rename(tmp_path / "snapshot-000001.tmp")

    assert read_newest(tmp_path) is None


def test_a_file_is_replaced_as_a_whole(tmp_path):
    write_atomically(tmp_path / "x", b"old")
    write_atomically(tmp_path / "x", b"new")

    assert (tmp_path / "x").read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize("name", ["", ".", "..", ".hidden", "a/b", "a\\b", "a b", "ä", "x" * 129])
def test_names_that_could_leave_the_folder_are_refused(name):
    with pytest.raises(InputError, match="session"):
        check_session_name(name)


@pytest.mark.parametrize("name", ["a", "kitchen-real", "run_2.1", "x" * 128])
def test_plain_names_are_fine(name):
    check_session_name(name)
