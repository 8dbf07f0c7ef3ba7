"""One set of real services for all tests that leave them healthy."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from benchmarks.local_gateway import PATIENT_SERVICES
from pointslam.launcher import LaunchOptions, Services


@pytest.fixture(scope="session")
def services(tmp_path_factory) -> Iterator[Services]:
    """A router, a gateway, two trackers and a mapper; who kills one of them restarts it."""
    folder = tmp_path_factory.mktemp("services")
    traces = f"file:{folder / 'traces'}"
    options = LaunchOptions(
        folder / "data",
        folder / "logs",
        device="cpu",
        traces=traces,
        settings=PATIENT_SERVICES,
    )
    with Services(options) as started:
        yield started
