"""What the gateway counts, as Prometheus reads it."""

from __future__ import annotations

import httpx
from prometheus_client.parser import text_string_to_metric_families


def sample(gateway, name: str, **labels: str) -> float:
    """A sample's value on the gateway's page; 0 while it was never counted."""
    page = httpx.get(f"{gateway.url}/metrics").raise_for_status().text
    samples = [s for family in text_string_to_metric_families(page) for s in family.samples]
    return sum(s.value for s in samples if s.name == name and s.labels == labels)


def test_answered_frames_are_counted_by_outcome(gateway, offline, rgb, depth):
    before = sample(gateway, "pointslam_frames_total", outcome="TRACKED")

    offline.track(rgb, depth, 0)
    offline.track(rgb, depth, 1_000_000)

    assert sample(gateway, "pointslam_frames_total", outcome="TRACKED") == before + 2


def test_the_time_of_each_frame_is_counted(gateway, offline, rgb, depth):
    before = sample(gateway, "pointslam_frame_seconds_count", stage="total")

    offline.track(rgb, depth, 0)

    assert sample(gateway, "pointslam_frame_seconds_count", stage="total") == before + 1
