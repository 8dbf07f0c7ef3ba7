"""What is kept of every answered frame."""

from __future__ import annotations

import numpy as np
import pytest

from services.mapping.storage.frame_records import FrameRecords
from shared import se3
from shared.frames import TrackingStatus
from shared.tracks import FrameRecord


def record(seq: int) -> FrameRecord:
    rng = np.random.default_rng(seq)
    half = rng.normal(size=(6, 6))
    return FrameRecord(
        seq=seq,
        t_ns=seq * 33_000_000,
        status=list(TrackingStatus)[seq % 6],
        reference_seq=seq - seq % 5,
        T_reference_camera=se3.exp(rng.normal(size=6)),
        T_world_camera=se3.exp(rng.normal(size=6)),
        covariance=half + half.T,
    )


@pytest.fixture
def records() -> FrameRecords:
    records = FrameRecords()
    for seq in range(0, 3000, 3):
        records.append(record(seq))
    return records


def test_records_come_back_to_the_bit(records):
    found = records.all()

    assert len(found) == len(records) == 1000
    for kept in (found[0], found[1], found[500], found[999]):
        expected = record(kept.seq)
        assert (kept.t_ns, kept.status) == (expected.t_ns, expected.status)
        assert kept.reference_seq == expected.reference_seq
        assert np.array_equal(kept.T_reference_camera, expected.T_reference_camera)
        assert np.array_equal(kept.T_world_camera, expected.T_world_camera)
        assert np.array_equal(kept.covariance, expected.covariance)


def test_only_seqs_that_were_appended_are_held(records):
    assert [seq in records for seq in (-1, 0, 1, 1500, 2997, 2998, 5000)] == [
        *(False, True, False, True, True, False, False)
    ]


def test_without_records_there_is_no_last_one():
    assert (len(FrameRecords()), FrameRecords().last, 0 in FrameRecords()) == (0, None, False)
