"""Real services that are killed, frozen and cut off while three clients stream to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.aftermath import aftermath
from benchmarks.cluster import Cluster, running_cluster, wait_for
from benchmarks.players import Heard, Play, Player, play_all
from pointslam.client import Client
from pointslam.datasets import open_sequence
from pointslam.datasets.base import Sequence
from pointslam.launcher import LaunchOptions
from pointslam.settings import ROLES, ServiceSettings
from pointslam.synth import Noise, SynthOptions, record_scene
from shared.camera import Intrinsics

SMALL = Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
ROOM = SynthOptions(num_frames=40, num_views=1, noise=Noise.NONE, camera=SMALL)
# A machine that stands still for seconds breaks no connection; a frozen process is found dead.
BUS = {"bus": {"lease_s": 10.0}}
MAPPING = {"schedule": {"iterations_per_frame": 1}, "owner": {"lease_s": 2.0}}
# Which frames are lost is asked here, not how long those that are not may take.
GATEWAY = {
    "dispatch": {"live_wait_s": 60.0, "live_timeout_s": 60.0},
    "drain_streams_s": 60.0,
}
NUM_FRAMES = 45  # three seconds of play


@pytest.fixture(scope="session")
def recording(tmp_path_factory, lit_scene) -> Sequence:
    folder = tmp_path_factory.mktemp("recording") / "room"
    record_scene(folder, lit_scene, ROOM)
    return open_sequence(folder)


@pytest.fixture(scope="session")
def cluster_folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cluster")


@pytest.fixture
def data_folder(cluster_folder) -> Path:
    """Where the mappers keep their sessions."""
    return cluster_folder / "data"


@pytest.fixture(scope="session")
def started(cluster_folder) -> Iterator[Cluster]:
    options = LaunchOptions(
        cluster_folder,
        cluster_folder,
        num_trackers=2,
        num_mappers=2,
        device="cpu",
        settings=ServiceSettings(
            dict.fromkeys(ROLES, BUS) | {"mapping": BUS | MAPPING, "gateway": BUS | GATEWAY}
        ),
    )
    with running_cluster(cluster_folder, options) as cluster:
        yield cluster


@pytest.fixture
def cluster(started) -> Cluster:
    """All processes well; who ends one starts it again."""
    assert started.is_whole()
    started.wait_until_ready()
    return started


@pytest.fixture(scope="session")
def undisturbed(started, recording) -> Mapping[int, NDArray[np.float64]]:
    """The poses of a run in which nothing happens, frame by frame."""
    play = Play(recording, "offline", NUM_FRAMES, rate_hz=1000.0)
    heard = play_all(started.url, {"undisturbed": play})["undisturbed"].finish()
    assert len(heard.poses()) == NUM_FRAMES
    return heard.poses()


@pytest.fixture
def moment_s(request) -> float:
    """When it happens: at random, the same in every run of one test."""
    return np.random.default_rng(len(request.node.name)).uniform(0.7, 1.8)


@pytest.fixture
def streaming(cluster, recording, undisturbed, request):
    """Three clients that stream; when all have been served, nothing may be lost."""

    @contextmanager
    def run() -> Iterator[dict[str, Player]]:
        test = request.node.name.removeprefix("test_")[:40]
        modes = {f"{test}-offline-a": "offline", f"{test}-offline-b": "offline"}
        modes[f"{test}-live"] = "live"
        plays = {
            name: Play(recording, mode, NUM_FRAMES, holds_last=True) for name, mode in modes.items()
        }
        players = play_all(cluster.url, plays)
        wait_for(lambda: all(player.heard.replies for player in players.values()))
        yield players  # whatever happens happens before they end
        for name, player in players.items():
            assert_nothing_lost(cluster, name, player.finish(), undisturbed)
        with Client(cluster.url) as client:
            for name in players:
                client.session(name).delete()
        assert cluster.is_whole()

    return run


def assert_nothing_lost(cluster: Cluster, name: str, heard: Heard, undisturbed) -> None:
    after = aftermath(cluster.url, name, heard, undisturbed)
    assert (after.lost, after.refused, after.missing) == ([], [], []), name
    # Which neighbourhood a live frame is tracked in depends on when a keyframe arrives; where
    # frames were superseded the others are tracked over larger steps, from other keyframes.
    limit_m = (0.1 if heard.superseded() else 0.01) if name.endswith("live") else 0.001
    assert after.difference_m < limit_m, name
