"""Mapping service: owns the maps of sessions and answers for them on the bus."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from services.mapping.config import MappingConfig
from services.mapping.metrics import SessionCollector
from services.mapping.priority import others_give_way
from services.mapping.sessions.host import MapperHost, MapperSettings
from services.mapping.warm_up import warm_up
from shared.bus import open_bus
from shared.errors import ConfigError
from shared.metrics import add_metrics_arguments, serve_metrics
from shared.service import (
    announce_ready,
    endpoints,
    limit_blas_threads,
    run_service,
    service_arguments,
    settings_from,
    setup_logging,
    stop_event,
)
from shared.tracing import setup_tracing
from shared.warm_start import warm_start


def device_named(name: str) -> torch.device:
    """The device to work on; "auto" takes a GPU where there is one.

    Raises:
        ConfigError: there is no such device.
    """
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise ConfigError("--device cuda: torch finds no CUDA device here; use cpu or auto")
    return torch.device("cuda" if has_cuda and name != "cpu" else "cpu")


def main(argv: list[str]) -> None:
    """Read settings, warm up, connect, serve until told to stop."""
    parser = service_arguments(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder for the sessions")
    add_metrics_arguments(parser)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    arguments = parser.parse_args(argv)
    stop = stop_event()
    setup_logging(arguments.json_log)
    setup_tracing("mapping", arguments)
    limit_blas_threads()
    settings = MapperSettings(
        name=arguments.id,
        data=arguments.data,
        config=settings_from(arguments, MappingConfig()),
        device=device_named(arguments.device),
    )
    serve_metrics(arguments)
    warm_start(warm_up, stop)
    others_give_way(settings.config.owner.niceness)
    with open_bus(endpoints(arguments), settings.config.bus) as bus:
        host = MapperHost(bus, settings)
        SessionCollector(host.infos)
        host.start()
        announce_ready(arguments.id)
        stop.wait()
        bus.withdraw()  # gateways look for others while the sessions are saved
        host.close()


if __name__ == "__main__":
    sys.exit(run_service(main, sys.argv[1:]))
