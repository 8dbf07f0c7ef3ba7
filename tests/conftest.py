"""What tests of several parts share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from httpx._config import DEFAULT_TIMEOUT_CONFIG
from hypothesis import settings

from pointslam.synth import lit_room
from pointslam.synth.scene import Scene

# The same examples everywhere, and none that fails because the machine stood still for 0.2 s.
settings.register_profile("pointslam", derandomize=True, deadline=None)
settings.load_profile("pointslam")


@pytest.fixture(scope="session", autouse=True)
def patient_http() -> Iterator[None]:
    """A bare httpx call gives up after 5 s: a busy machine may stand still for as long."""
    with pytest.MonkeyPatch.context() as patch:
        for wait in ("connect", "read", "write", "pool"):
            patch.setattr(DEFAULT_TIMEOUT_CONFIG, wait, 60.0)
        yield


@pytest.fixture(scope="session")
def lit_scene() -> Scene:
    """The procedural room of seed 0 with its light, baked once for all recordings."""
    return lit_room(0)
