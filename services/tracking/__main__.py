"""Tracking service: RGB-D frames in, camera poses and keyframes out.

python -m services.tracking --connect tcp/127.0.0.1:7447 --id w0
"""

from __future__ import annotations

import sys

from shared.service import limit_blas_threads

limit_blas_threads()  # before numpy is imported, or it holds for nothing

from concurrent.futures import ThreadPoolExecutor  # noqa: E402

import cv2  # noqa: E402

from services.tracking.config import TrackingConfig  # noqa: E402
from services.tracking.warm_up import warm_up  # noqa: E402
from services.tracking.worker import Worker  # noqa: E402
from shared.bus import Keys, open_bus  # noqa: E402
from shared.frames import TrackRequest  # noqa: E402
from shared.localization import LocalizeRequest  # noqa: E402
from shared.metrics import add_metrics_arguments, serve_metrics  # noqa: E402
from shared.service import (  # noqa: E402
    announce_ready,
    endpoints,
    run_service,
    service_arguments,
    settings_from,
    setup_logging,
    stop_event,
)
from shared.tracing import setup_tracing  # noqa: E402
from shared.warm_start import warm_start  # noqa: E402


def main(argv: list[str]) -> None:
    """Serve frames until SIGTERM.

    Raises:
        PointSlamError: a setting is wrong or no router answers.
    """
    parser = service_arguments(__doc__)
    add_metrics_arguments(parser)
    arguments = parser.parse_args(argv)
    setup_logging(arguments.json_log)
    setup_tracing("tracking", arguments)
    config = settings_from(arguments, TrackingConfig())
    stop = stop_event()
    cv2.setNumThreads(1)  # frames of several sessions are what runs side by side
    serve_metrics(arguments)
    warm_start(lambda: warm_up(config), stop)
    with (
        open_bus(endpoints(arguments), config.bus) as bus,
        ThreadPoolExecutor(config.concurrent_frames, "frame") as executor,
        ThreadPoolExecutor(1, "localize") as beside,  # no frame waits for a search of the map
    ):
        worker = Worker(bus, config)
        bus.serve(Keys.track(arguments.id), TrackRequest, worker.answer, executor)
        bus.serve(Keys.localize(arguments.id), LocalizeRequest, worker.localize, beside)
        bus.declare_alive("tracking", arguments.id)
        announce_ready(arguments.id)
        stop.wait()
        bus.withdraw()  # no new frame comes while those under way are finished


if __name__ == "__main__":
    sys.exit(run_service(main, sys.argv[1:]))
