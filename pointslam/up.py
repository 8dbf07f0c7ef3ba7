"""The services on this machine until Ctrl-C; what ends is started again."""

from __future__ import annotations

from collections.abc import Callable

from pointslam.launcher import LaunchOptions, Services
from shared.addresses import host_port
from shared.service import stop_event

_LOOK_EVERY_S = 1.0


def keep_up(options: LaunchOptions, say: Callable[[str], None]) -> None:
    """Run until SIGINT or SIGTERM.

    Raises:
        UnavailableError: a service did not start.
    """
    stop = stop_event()
    with Services(options) as services:
        for url, grpc_port in zip(services.urls, services.grpc_ports, strict=True):
            say(f"http {url}  (API: {url}/docs)")
            say(f"grpc {host_port(options.access.host, grpc_port)}")
        say(f"maps {options.data}, logs {options.logs}; Ctrl-C ends")
        while not stop.wait(_LOOK_EVERY_S):
            for name in services.restart_ended():
                say(f"{name} had ended and was started again")
