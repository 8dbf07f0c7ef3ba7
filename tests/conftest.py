"""What tests of several parts share."""

from __future__ import annotations

import pytest

from pointslam.synth import lit_room
from pointslam.synth.scene import Scene


@pytest.fixture(scope="session")
def lit_scene() -> Scene:
    """The procedural room of seed 0 with its light, baked once for all recordings."""
    return lit_room(0)
