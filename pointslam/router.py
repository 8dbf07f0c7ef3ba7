"""A zenoh router for one machine; in compose and beyond it is the eclipse/zenoh image."""

from __future__ import annotations

import argparse
import sys

from shared.bus import open_router
from shared.service import announce_ready, run_service, setup_logging, stop_event


def main(argv: list[str]) -> None:
    """Route until SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--listen", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    arguments = parser.parse_args(argv)
    setup_logging()
    stop = stop_event()
    session = open_router(arguments.listen)
    announce_ready("router")
    stop.wait()
    session.close()


if __name__ == "__main__":
    sys.exit(run_service(main, sys.argv[1:]))
