"""Small recordings in the published layouts, and the data folder where it exists."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from pointslam.datasets import FileSequence, open_sequence
from pointslam.synth import Noise, SynthOptions, record_scene
from shared.camera import Intrinsics

ROOM = SynthOptions(
    num_frames=34,
    num_views=2,
    noise=Noise.NONE,
    camera=Intrinsics(131.25, 131.25, 79.5, 59.5, 160, 120),
)


@pytest.fixture(scope="session")
def room_options() -> SynthOptions:
    """How `room` was made."""
    return ROOM


@pytest.fixture(scope="session")
def room(tmp_path_factory, lit_scene) -> FileSequence:
    """A small procedural sequence without noise."""
    folder = tmp_path_factory.mktemp("synth") / "room"
    record_scene(folder, lit_scene, ROOM)
    return open_sequence(folder)


@pytest.fixture
def write_images():
    """A function that writes one colour and one depth image."""

    def write(rgb: Path, depth: Path | None, size=(64, 48), depth_size=None, level=1000) -> None:
        noise = np.random.default_rng(level).integers(0, 255, (size[1], size[0], 3), np.uint8)
        rgb.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(rgb), noise)
        if depth is not None:
            width, height = depth_size or size
            depth.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(depth), np.full((height, width), level, np.uint16))

    return write


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of recorded sequences; skips where it is absent."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = Path(os.environ.get("POINTSLAM_DATA", beside))
    if not folder.is_dir():
        pytest.skip("no recorded sequences: set POINTSLAM_DATA to their folder")
    return folder
