"""The page that Prometheus reads."""

from __future__ import annotations

import argparse
import socket
import urllib.request

import pytest
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from shared.errors import UnavailableError
from shared.metrics import add_metrics_arguments, observe_stages, seconds, serve_metrics


def arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_metrics_arguments(parser)
    return parser.parse_args(words)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def test_a_service_serves_its_own_numbers_and_the_processes():
    port = free_port()

    serve_metrics(arguments("--metrics-port", str(port)))

    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as page:
        names = {family.name for family in text_string_to_metric_families(page.read().decode())}
    assert "process_resident_memory_bytes" in names


def test_a_port_that_is_taken_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]

        with pytest.raises(UnavailableError, match=str(port)):
            serve_metrics(arguments("--metrics-port", str(port)))


def test_stage_times_are_counted_in_seconds():
    histogram = seconds("test_stage_seconds", "Of this test", "stage")

    observe_stages(histogram, {"decode": 5.0, "orb": 8.0})

    page = generate_latest().decode()
    assert 'pointslam_test_stage_seconds_sum{stage="decode"} 0.005' in page
