"""A mapper with its fill of sessions: whose place is free for one more."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from benchmarks.local_gateway import PATIENT_BUS, PATIENT_ROUTER, free_port
from services.mapping.config import MappingConfig, OwnerConfig
from services.mapping.sessions.host import MapperHost, MapperSettings
from shared.bus import open_bus, open_router
from shared.errors import UnavailableError
from shared.tracks import OpenRequest


@pytest.fixture
def bus():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = open_router(endpoint, PATIENT_ROUTER)
    with open_bus([endpoint], PATIENT_BUS) as bus:
        yield bus
    router.close()


@contextmanager
def full_mapper(bus, folder, calibration, yield_idle_s):
    """It has room for two sessions, and has them."""
    owner = OwnerConfig(max_sessions=2, yield_idle_s=yield_idle_s)
    settings = MapperSettings("m", folder, MappingConfig(owner=owner), torch.device("cpu"))
    host = MapperHost(bus, settings)
    for name in ("first", "second"):
        host.open(new(name, calibration))
    yield host
    host.close()


def new(name, calibration):
    return OpenRequest(name, "offline", 0, calibration, np.eye(4))


def open_sessions(host):
    return {summary.session for summary in host.list().sessions if summary.is_open}


def test_the_session_that_rests_longest_gives_its_place_and_is_saved(bus, tmp_path, calibration):
    with full_mapper(bus, tmp_path, calibration, yield_idle_s=0.0) as host:
        host.open(new("third", calibration))

        assert open_sessions(host) == {"second", "third"}
        assert host.open(OpenRequest("first", "offline")).epoch == 2
        assert open_sessions(host) == {"third", "first"}


def test_a_session_in_use_keeps_its_place(bus, tmp_path, calibration):
    with full_mapper(bus, tmp_path, calibration, yield_idle_s=3600.0) as host:
        with pytest.raises(UnavailableError, match="2 sessions in use"):
            host.open(new("third", calibration))

        assert open_sessions(host) == {"first", "second"}


def test_a_mapper_that_is_ending_opens_nothing(bus, tmp_path, calibration):
    with full_mapper(bus, tmp_path, calibration, yield_idle_s=0.0) as host:
        host.close()

        with pytest.raises(UnavailableError, match="is ending"):
            host.open(OpenRequest("first", "offline"))


def test_the_list_does_not_wait_for_a_session_that_is_opened_or_saved(bus, tmp_path, calibration):
    with (
        full_mapper(bus, tmp_path, calibration, yield_idle_s=0.0) as host,
        ThreadPoolExecutor(1) as another,
        host._lock,  # as while a large session is read from disk
    ):
        assert another.submit(open_sessions, host).result(timeout=60.0) == {"first", "second"}


def test_a_session_that_is_just_being_deleted_does_not_hide_the_others(bus, tmp_path, calibration):
    with full_mapper(bus, tmp_path, calibration, yield_idle_s=0.0) as host:
        (tmp_path / "second" / "session.msgpack").unlink()
        (tmp_path / "second" / "session.msgpack").mkdir()  # named, but not to be read

        assert open_sessions(host) == {"first"}
