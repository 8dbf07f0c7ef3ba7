"""A zenoh router for one machine; in compose and beyond it is the eclipse/zenoh image."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from shared.bus import open_router
from shared.fabric import RouterConfig
from shared.service import (
    announce_ready,
    run_service,
    settings_from,
    setup_logging,
    stop_event,
)

_DEFAULT = "tcp/127.0.0.1:7447"


def main(argv: list[str]) -> None:
    """Route until SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--listen", metavar="ENDPOINT", help=f"{_DEFAULT} unless settings say")
    parser.add_argument("--config", type=Path, help="YAML file: users, certificates, access list")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args(argv)
    setup_logging()
    stop = stop_event()
    config = settings_from(arguments, RouterConfig())
    session = open_router(arguments.listen or ("" if config.listen else _DEFAULT), config)
    announce_ready("router")
    stop.wait()
    session.close()


if __name__ == "__main__":
    sys.exit(run_service(main, sys.argv[1:]))
