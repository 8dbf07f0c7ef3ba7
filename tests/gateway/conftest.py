"""A real gateway process on a real router, with stand-ins for the trackers and the mapper."""

import numpy as np
import pytest

from benchmarks.local_gateway import PATIENCE, local_gateway
from pointslam.client import Client
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import TrackingStatus

WIDTH, HEIGHT = 64, 48


@pytest.fixture(scope="session")
def gateway():
    with local_gateway(2, *PATIENCE) as running:
        with Client(running.url) as client:
            while not client.ready():
                pass
        yield running


@pytest.fixture
def trackers(gateway):
    yield gateway.trackers
    for tracker in gateway.trackers:
        tracker.delay_s, tracker.decodes, tracker.status = 0.0, False, TrackingStatus.TRACKED
        tracker.may_answer.set()


@pytest.fixture
def client(gateway):
    with Client(gateway.url) as client:
        yield client


@pytest.fixture(scope="session")
def calibration():
    return Calibration(
        Camera(Intrinsics(60.0, 60.0, 31.5, 23.5, WIDTH, HEIGHT)), depth_scale=1000.0
    )


@pytest.fixture(scope="session")
def rgb():
    return np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


@pytest.fixture(scope="session")
def depth():
    return np.full((HEIGHT, WIDTH), 1500, np.uint16)


@pytest.fixture
def offline(client, calibration):
    session = client.create_session(calibration, mode="offline")
    yield session
    session.delete()


@pytest.fixture
def live(client, calibration):
    session = client.create_session(calibration, mode="live")
    yield session
    session.delete()
