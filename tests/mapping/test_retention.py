"""Sessions that leave the disk by a rule, and those that no rule touches."""

import os
import time

import numpy as np
import pytest
import torch

from benchmarks.local_gateway import PATIENT_BUS, PATIENT_ROUTER, free_port
from services.mapping.config import MappingConfig, OwnerConfig, RetentionConfig
from services.mapping.sessions.host import MapperHost, MapperSettings
from services.mapping.storage.retention import StoredSession, overdue
from shared.bus import open_bus, open_router
from shared.maps import DeleteRequest, PinRequest
from shared.tracks import OpenRequest

DAY_S = 86_400.0
STORED = [StoredSession(name, 10**9, day * DAY_S) for name, day in (("b", 2), ("a", 1), ("c", 3))]


def test_without_a_rule_nothing_is_overdue():
    assert overdue(STORED, RetentionConfig(), 1e9 * DAY_S) == []


def test_what_is_too_old_goes_oldest_first():
    assert overdue(STORED, RetentionConfig(max_days=1.5), 4 * DAY_S) == ["a", "b"]


def test_what_is_too_much_goes_oldest_first_until_it_fits():
    assert overdue(STORED, RetentionConfig(max_gb=2.5), 3 * DAY_S) == ["a"]


def test_what_is_open_or_pinned_stays_and_counts():
    kept = StoredSession("k", 10**9, 0.0, is_kept=True)

    assert overdue([*STORED, kept], RetentionConfig(max_gb=2.5), 3 * DAY_S) == ["a", "b"]


@pytest.fixture
def bus():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = open_router(endpoint, PATIENT_ROUTER)
    with open_bus([endpoint], PATIENT_BUS) as bus:
        yield bus
    router.close()


def age(folder, days):
    for path in [*folder.rglob("*"), folder]:
        os.utime(path, (time.time() - days * DAY_S,) * 2)


def test_a_mapper_deletes_every_byte_of_what_is_old_and_nothing_else(bus, tmp_path, calibration):
    config = MappingConfig(
        owner=OwnerConfig(session_idle_s=0.4), retention=RetentionConfig(max_days=1.0)
    )
    host = MapperHost(bus, MapperSettings("m", tmp_path, config, torch.device("cpu")))
    for name in ("old", "pinned", "young"):
        host.open(OpenRequest(name, "offline", 0, calibration, np.eye(4)))
    host.pin(PinRequest("pinned", True))
    host.start()
    deadline = time.monotonic() + 60.0
    while any(summary.is_open for summary in host.list().sessions):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    for name in ("old", "pinned"):
        age(tmp_path / name, 2.0)

    while (tmp_path / "old").exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)

    assert {summary.session for summary in host.list().sessions} == {"pinned", "young"}
    assert not [path for path in tmp_path.rglob("*") if "old" in path.name]
    host.close()


def test_a_session_that_is_open_is_never_deleted_however_old(bus, tmp_path, calibration):
    config = MappingConfig(retention=RetentionConfig(max_days=1.0))
    host = MapperHost(bus, MapperSettings("m", tmp_path, config, torch.device("cpu")))
    host.open(OpenRequest("open", "offline", 0, calibration, np.eye(4)))
    age(tmp_path / "open", 2.0)

    host._delete_overdue()

    assert [summary.session for summary in host.list().sessions] == ["open"]
    host.delete(DeleteRequest("open"))
    assert not (tmp_path / "open").exists()
    host.close()
