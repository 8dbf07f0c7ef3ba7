import dataclasses
import signal
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks.local_gateway import PATIENT_BUS, PATIENT_ROUTER, free_port
from services.mapping.keyframes.store import KeyframeStore
from services.tracking.config import RegistrationConfig, TrackingConfig
from services.tracking.local_map import derive
from services.tracking.worker import ContextCache, Worker
from shared.bus import Bus, Keys, open_bus, open_router
from shared.camera import Calibration, Camera
from shared.errors import InputError, UnavailableError
from shared.frames import ColourEncoding, ColourImage, TrackingStatus
from shared.se3 import exp
from shared.tracks import CandidatesRequest, ContextRequest, TrackResult


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = open_router(endpoint, PATIENT_ROUTER)
    yield endpoint
    router.close()


@pytest.fixture
def bus(endpoint) -> Iterator[Bus]:
    with open_bus([endpoint], PATIENT_BUS) as bus:
        yield bus


@pytest.fixture
def asked(bus, session) -> list[ContextRequest]:
    """Serves the session's map; collects what contexts were asked for."""
    requests: list[ContextRequest] = []

    def context(request: ContextRequest):
        requests.append(request)
        return session.store.context(request.reference_seq)

    bus.serve(Keys.session("test", 1, "context"), ContextRequest, context)
    bus.serve(
        Keys.session("test", 1, "candidates"),
        CandidatesRequest,
        lambda r: session.store.candidates(r),
    )
    return requests


def step(index: int) -> np.ndarray:
    return exp([0.03 * index, 0.0, 0.01 * index, 0.0, 0.01 * index, 0.0])


def test_the_least_recently_used_context_leaves_first():
    cache = ContextCache(limit=2)
    context = KeyframeStore().context(-1)
    a, b, c = (derive(context, RegistrationConfig()) for _ in range(3))

    cache.put(("s", 1, 1, 0, False), a)
    cache.put(("s", 1, 2, 0, False), b)
    cache.get(("s", 1, 1, 0, False))
    cache.put(("s", 1, 3, 0, False), c)

    assert cache.get(("s", 1, 2, 0, False)) is None
    assert cache.get(("s", 1, 1, 0, False)) is a
    assert len(cache) == 2


def test_a_context_is_fetched_once_a_revision(bus, asked, session, room):
    worker = Worker(bus, TrackingConfig())
    session.track(room.frame(0, step(0)))

    for i in range(1, 4):
        worker.answer(session.request(room.frame(i, step(i))))

    assert asked == [ContextRequest(revision=1, reference_seq=0)]


def test_a_fresh_worker_gives_the_bits_of_a_warm_one(bus, asked, session, room):
    warm = Worker(bus, TrackingConfig())
    for i in range(4):
        warm.answer(session.request(room.frame(i, step(i))))
        session.track(room.frame(i, step(i)))
    request = session.request(room.frame(4, step(4)))

    a, b = warm.answer(request), Worker(bus, TrackingConfig()).answer(request)

    np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert (a.inliers, a.reference_seq, a.status) == (b.inliers, b.reference_seq, b.status)


def test_a_live_frame_without_an_owner_is_tracked_in_the_last_neighbourhood(bus, session, room):
    worker = Worker(bus, TrackingConfig(query_timeout_s=60.0))
    stop = bus.serve(
        Keys.session("test", 1, "context"),
        ContextRequest,
        lambda request: session.store.context(request.reference_seq),
    )
    session.track(room.frame(0, step(0)))
    worker.answer(session.request(room.frame(1, step(1))))
    stop()
    later = dataclasses.replace(session.request(room.frame(2, step(2))), epoch=2)

    with pytest.raises(UnavailableError):
        worker.answer(later)
    result = worker.answer(dataclasses.replace(later, accepts_older_map=True))

    assert (result.status, result.map_revision) == (TrackingStatus.TRACKED, 1)
    np.testing.assert_allclose(result.T_world_camera, step(2), atol=2e-3)


def test_a_map_that_was_empty_when_it_was_asked_for_is_no_neighbourhood_of_a_later_frame(
    bus, session, room
):
    worker = Worker(bus, TrackingConfig(query_timeout_s=60.0))
    stop = bus.serve(
        Keys.session("test", 1, "context"),
        ContextRequest,
        lambda request: session.store.context(request.reference_seq),
    )
    worker.answer(session.request(room.frame(0, step(0))))  # the map begins with another's answer
    stop()
    session.track(room.frame(0, step(0)))
    session.track(room.frame(1, step(1)))
    later = dataclasses.replace(session.request(room.frame(2, step(2))), accepts_older_map=True)

    with pytest.raises(UnavailableError):
        worker.answer(later)


def test_an_impossible_calibration_is_refused_by_name(bus, session, room):
    request = session.request(room.frame(0, np.eye(4)))
    camera = dataclasses.replace(room.intrinsics, fx=float("nan"))
    broken = dataclasses.replace(request, calibration=Calibration(Camera(camera), 1000.0))

    with pytest.raises(InputError, match="calibration.colour.fx"):
        Worker(bus, TrackingConfig()).answer(broken)


def test_without_an_owner_of_the_map_the_worker_says_so(bus, session, room):
    request = dataclasses.replace(session.request(room.frame(0, np.eye(4))), session="nobody")

    with pytest.raises(UnavailableError):
        Worker(bus, TrackingConfig(query_timeout_s=60.0)).answer(request)


@pytest.fixture
def process(endpoint) -> Iterator[subprocess.Popen]:
    command = [sys.executable, "-m", "services.tracking", "--connect", endpoint, "--id", "w7"]
    command += ["--set", "bus.lease_s=60.0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "READY w7\n"
    yield process
    process.kill()
    process.wait()


@pytest.mark.system
def test_a_process_answers_frames_refuses_bad_ones_and_ends_on_sigterm(
    process, bus, asked, session, room
):
    good = session.request(room.frame(0, np.eye(4)))
    cut = dataclasses.replace(good.frame, rgb=ColourImage(ColourEncoding.JPEG, b"\xff\xd8\xff"))

    with pytest.raises(InputError, match="rgb.bytes"):
        bus.query(Keys.track("w7"), dataclasses.replace(good, frame=cut), TrackResult, 60.0)
    result = bus.query(Keys.track("w7"), good, TrackResult, 60.0)
    process.send_signal(signal.SIGTERM)

    assert result.status is TrackingStatus.TRACKED
    assert result.keyframe is not None
    assert process.wait(timeout=60) == 0


@pytest.mark.system
def test_an_unknown_setting_stops_the_process_with_one_line(endpoint):
    command = [sys.executable, "-m", "services.tracking", "--connect", endpoint]

    ended = subprocess.run([*command, "--set", "surface.strides=3"], capture_output=True, text=True)

    assert ended.returncode == 2
    assert "unknown setting surface.strides" in ended.stderr
