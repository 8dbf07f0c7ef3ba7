"""One set of real services for all tests that leave them healthy."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pointslam.launcher import LaunchOptions, Services
from pointslam.settings import ROLES, ServiceSettings


@pytest.fixture(scope="session")
def services(tmp_path_factory) -> Iterator[Services]:
    """A router, a gateway, two trackers and a mapper; who kills one of them restarts it."""
    folder = tmp_path_factory.mktemp("services")
    traces = f"file:{folder / 'traces'}"
    # A machine that stands still for seconds is no failure that these tests tell of.
    patient = {role: {"bus": {"lease_s": 60.0}} for role in ROLES}
    options = LaunchOptions(
        folder / "data",
        folder / "logs",
        device="cpu",
        traces=traces,
        settings=ServiceSettings(patient),
    )
    with Services(options) as started:
        yield started
