"""The open sessions' figures, as Prometheus reads them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from prometheus_client import REGISTRY, generate_latest

from services.mapping.metrics import SessionCollector
from shared.maps import JobStatus, MapInfo


@pytest.fixture
def info() -> MapInfo:
    numbers = {"epoch": 3, "frames": 9, "keyframes": 4, "primary_anchors": 10}
    zeros = dict.fromkeys(("map_revision", "landmarks", "iterations", "pending", "map_bytes"), 0)
    return MapInfo(
        session="room",
        mapper="m0",
        mode="live",
        secondary_anchors=90,
        psnr_db=None,
        refinement=JobStatus(),
        stages_ms={},
        iteration_ms=None,
        mapping_s=0.0,
        refinement_s=0.0,
        device="cpu",
        **numbers,
        **zeros,
    )


@pytest.fixture
def sessions(info) -> Iterator[list[MapInfo]]:
    sessions = [info]
    collector = SessionCollector(lambda: sessions)
    yield sessions
    REGISTRY.unregister(collector)


def test_every_open_session_shows_its_figures(sessions):
    page = generate_latest().decode()

    assert 'pointslam_map_anchors{session="room"} 100.0' in page
    assert 'pointslam_map_epoch{session="room"} 3.0' in page


def test_a_session_that_was_put_away_is_not_shown(sessions):
    sessions.clear()

    assert 'session="room"' not in generate_latest().decode()
