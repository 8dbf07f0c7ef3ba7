"""A browser, real services behind the page, and a session with 60 frames of a room."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.browser import Page, chromium_path, open_page
from benchmarks.local_gateway import PATIENT_SERVICES
from pointslam.client import Client
from pointslam.datasets import open_sequence
from pointslam.launcher import LaunchOptions, Services
from pointslam.synth import Noise, SynthOptions, record_scene
from shared.camera import Intrinsics

ROOM = SynthOptions(
    num_frames=60,
    num_views=1,
    noise=Noise.NONE,
    camera=Intrinsics(131.25, 131.25, 79.5, 59.5, 160, 120),
)


@dataclass(frozen=True)
class Console:
    """A page in a browser on services that hold a session named `room`."""

    page: Page
    url: str
    pictures: Path  # screenshots are kept here, for people to look at

    def picture(self, name: str) -> None:
        """Keep what the page looks like."""
        self.page.screenshot(self.pictures / f"{name}.jpg")


@pytest.fixture(scope="session")
def browser() -> Iterator[Page]:
    path = chromium_path()
    if path is None:
        pytest.skip("no chromium on this machine: apt-get install chromium")
    with open_page(path) as page:
        yield page


@pytest.fixture(scope="session")
def pictures(tmp_path_factory) -> Path:
    """The folder for screenshots: $POINTSLAM_PICTURES, or one that is forgotten."""
    named = os.environ.get("POINTSLAM_PICTURES")
    return Path(named) if named else tmp_path_factory.mktemp("pictures")


@pytest.fixture(scope="module")
def console(browser, pictures, tmp_path_factory, lit_scene) -> Iterator[Console]:
    folder = tmp_path_factory.mktemp("console")
    record_scene(folder / "room", lit_scene, ROOM)
    room = open_sequence(folder / "room")
    options = LaunchOptions(
        folder / "data",
        folder / "logs",
        num_trackers=1,
        device="cpu",
        settings=PATIENT_SERVICES,
    )
    with Services(options) as services, Client(services.url) as client:
        while not client.ready():
            pass
        session = client.create_session(room.calibration, name="room", T_map_first=room.truth(0))
        browser.resize(1440, 900)
        browser.forget()
        browser.open(f"{services.url}/")
        browser.wait_for("document.body?.dataset.ready === 'true'")
        frames = (room.frame(i) for i in range(len(room)))
        for frame in frames:
            session.track(frame.rgb, frame.depth, frame.t_ns)
        yield Console(browser, services.url, pictures)
