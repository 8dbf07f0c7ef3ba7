"""The README's Python examples run as they are printed, but for the addresses."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pointslam.client import Client
from pointslam.synth import Noise, SynthOptions
from pointslam.synth.path import camera_path
from pointslam.synth.record import render_frame
from shared.frames import HAS_POSE
from shared.localization import LocalizationStatus

pytestmark = pytest.mark.system

README = Path(__file__).resolve().parents[2] / "README.md"
ROOM = SynthOptions(num_frames=3, noise=Noise.NONE)


def example(number: int, printed: str, actual: str) -> str:
    """One of the README's Python blocks with another address."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) == 3 and printed in blocks[number]
    return blocks[number].replace(printed, actual)


@pytest.fixture(scope="module")
def camera(lit_scene):
    """Three frames of the example's camera: colour, depth in millimetres, time."""
    rng = np.random.default_rng(0)
    frames = []
    for i, T_world_camera in enumerate(camera_path(400)[:3]):
        rgb, depth_m = render_frame(lit_scene, T_world_camera, ROOM, rng)
        frames.append((rgb, np.round(1000 * depth_m).astype(np.uint16), i * 33_333_333))
    return frames


@pytest.fixture(scope="module")
def headset(services, camera):
    """What the headset's example leaves behind; its session lives on."""
    names = {"camera": camera, "T_world_camera": np.eye(4)}
    exec(example(0, "http://127.0.0.1:8080", services.url), names)
    yield names
    with Client(services.url) as client:
        client.session("kitchen").delete()


def test_the_headsets_example_tracks_and_renders(headset):
    assert headset["reply"].seq == 2
    assert headset["reply"].status in HAS_POSE
    assert headset["view"].rgb.shape == (480, 640, 3)
    assert (headset["view"].alpha > 128).mean() > 0.5


def test_the_robots_example_gets_the_headsets_pose(headset, services):
    names = {}

    exec(example(1, "127.0.0.1:50051", f"127.0.0.1:{services.grpc_port}"), names)

    told = headset["reply"].T_map_camera.position
    assert names["pose"].T_map_camera.position.x == pytest.approx(told.x, abs=1e-9)


def test_the_example_of_one_image_finds_it(headset, services, camera):
    names = {"rgb": camera[1][0], "depth": camera[1][1]}

    exec(example(2, "http://127.0.0.1:8080", services.url), names)

    assert names["found"].status is LocalizationStatus.LOCALISED
    assert names["found"].pos_std_m < 0.02
