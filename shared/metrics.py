"""What a service counts, for Prometheus: names with units, bounded labels, one page a process.

Each service declares its own metrics in its `metrics.py`; the process's memory, processor time
and open files are there by themselves.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from prometheus_client import Counter, Gauge, Histogram, start_http_server

from shared.errors import UnavailableError

# Of everything between a cheap stage and a slow snapshot, seconds.
_BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


def counter(name: str, text: str, *labels: str) -> Counter:
    """A number that only grows; Prometheus appends `_total`."""
    return Counter(f"pointslam_{name}", text, labels)


def gauge(name: str, text: str, *labels: str) -> Gauge:
    """A number that goes up and down."""
    return Gauge(f"pointslam_{name}", text, labels)


def seconds(name: str, text: str, *labels: str) -> Histogram:
    """A distribution of times; `name` ends with `_seconds`."""
    return Histogram(f"pointslam_{name}", text, labels, buckets=_BUCKETS_S)


def observe_stages(histogram: Histogram, times_ms: Mapping[str, float]) -> None:
    """Add one frame's stage times in milliseconds to a histogram with the label `stage`."""
    for stage, milliseconds in times_ms.items():
        histogram.labels(stage).observe(milliseconds / 1e3)


def add_metrics_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of a service without an HTTP server of its own."""
    parser.add_argument(
        "--metrics-port", type=int, default=0, metavar="P", help="Prometheus page; 0 serves none"
    )
    parser.add_argument("--metrics-host", default="127.0.0.1", metavar="ADDRESS")


def serve_metrics(arguments: argparse.Namespace) -> None:
    """Serve the page for as long as the process lives, if a port is given.

    Raises:
        UnavailableError: the port cannot be listened on.
    """
    if not arguments.metrics_port:
        return
    try:
        start_http_server(arguments.metrics_port, arguments.metrics_host)
    except OSError as error:
        raise UnavailableError(
            f"metrics cannot listen on {arguments.metrics_host}:{arguments.metrics_port}: {error}"
        ) from None
