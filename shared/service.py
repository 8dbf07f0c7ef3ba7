"""The process around a service: arguments, log, threads, and a clean end on SIGTERM."""

from __future__ import annotations

import argparse
import gc
import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from shared.config import override, read_overrides
from shared.errors import ConfigError, PointSlamError
from shared.fabric import BusConfig
from shared.tracing import add_tracing_arguments, present_fields

C = TypeVar("C")


def service_arguments(description: str | None) -> argparse.ArgumentParser:
    """The arguments that every service takes."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="zenoh router, such as tcp/127.0.0.1:7447; repeat for fail-over",
    )
    parser.add_argument("--id", default=f"{os.uname().nodename}-{os.getpid()}", help="unique name")
    parser.add_argument("--config", type=Path, help="YAML file with settings of this service")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one setting, dotted key"
    )
    parser.add_argument("--json-log", action="store_true", help="one JSON object a line")
    add_tracing_arguments(parser)
    return parser


def settings_from(arguments: argparse.Namespace, defaults: C) -> C:
    """Defaults, overridden by --config and --set.

    Raises:
        ConfigError: a key is unknown or a value does not fit.
    """
    return override(defaults, read_overrides(arguments.config, arguments.set))


def bus_settings(file: Path | None) -> BusConfig:
    """The connection's part of a service's settings file, for who is not the service itself.

    Raises:
        ConfigError: as `settings_from`.
    """
    group = read_overrides(file, ()).get("bus", {})
    if not isinstance(group, dict):
        raise ConfigError(f"bus is a group of settings, got {group!r}")
    return override(BusConfig(), group, "bus.")


def endpoints(arguments: argparse.Namespace) -> list[str]:
    """The routers to connect to."""
    return arguments.connect or ["tcp/127.0.0.1:7447"]


class JsonFormatter(logging.Formatter):
    """One JSON object a line, with what `log_fields` says."""

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
            **present_fields(),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def setup_logging(as_json: bool = False) -> None:
    """Log to standard error, one line an event."""
    handler = logging.StreamHandler(sys.stderr)
    text = logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s")
    handler.setFormatter(JsonFormatter() if as_json else text)
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)


def limit_blas_threads() -> None:
    """One thread for BLAS and OpenMP: the small solvers lose by more, our own pools use the rest.

    Must run before numpy is imported to hold for it; `python -m services.X` does so through the
    environment that the launcher and the images set. Here it covers libraries loaded later.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def stop_event() -> threading.Event:
    """An event that SIGTERM and SIGINT set."""
    event = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: event.set())
    return event


def announce_ready(name: str) -> None:
    """Tell whoever started this process that it serves: one line on standard output.

    What it has loaded by now stays to its end, so no collection of garbage looks through it any
    more: that took 60 ms of a gateway's event loop each time.
    """
    gc.collect()
    gc.freeze()
    sys.stdout.write(f"READY {name}\n")
    sys.stdout.flush()


def run_service(main: Callable[[list[str]], None], argv: list[str]) -> int:
    """Call `main(argv)`; an error of ours becomes one line and exit code 2."""
    try:
        main(argv)
    except PointSlamError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0
