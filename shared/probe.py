"""Is a service of this host alive? Exit code 0 if it is: the containers' health check."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from shared.bus import open_bus
from shared.service import bus_settings, endpoints, run_service


def main(argv: list[str]) -> None:
    """Look for a liveliness token of the role whose name starts with this host's name."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("role", choices=["tracking", "mapping"])
    parser.add_argument("--connect", action="append", metavar="ENDPOINT")
    parser.add_argument("--prefix", default=os.uname().nodename, help="start of the service's --id")
    parser.add_argument("--config", type=Path, help="the service's settings: how it connects")
    arguments = parser.parse_args(argv)
    config = bus_settings(arguments.config)
    with open_bus(endpoints(arguments), config, wait_s=3.0) as bus:
        bus.require_alive(arguments.role, arguments.prefix)


if __name__ == "__main__":
    sys.exit(run_service(main, sys.argv[1:]))
