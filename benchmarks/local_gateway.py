"""A router, stand-ins on its bus, and a real gateway process: what the gateway's tests and
benchmark run against."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from benchmarks.stand_ins import StandInMapper, StandInTracker
from pointslam.launcher import free_ports
from pointslam.settings import ROLES, ServiceSettings
from shared.bus import Bus, open_bus, open_router
from shared.fabric import BusConfig, RouterConfig

# A machine that stands still for seconds is no reason to take a process for dead.
PATIENT_BUS = BusConfig(lease_s=60.0)
PATIENT_ROUTER = RouterConfig(bus=PATIENT_BUS)
PATIENCE = (
    "bus.lease_s=60.0",
    "dispatch.patience_s=60.0",
    "dispatch.live_timeout_s=60.0",
    "dispatch.live_wait_s=60.0",
    "dispatch.first_frame_timeout_s=60.0",
    "mapping.claim_wait_s=60.0",
    "mapping.probe_timeout_s=60.0",
    "stream.send_timeout_s=60.0",
)
PATIENT_SERVICES = ServiceSettings({role: {"bus": {"lease_s": 60.0}} for role in ROLES})


@dataclass(frozen=True)
class LocalGateway:
    """A running gateway and what is behind it."""

    url: str
    grpc_address: str
    router: str
    pid: int
    bus: Bus
    trackers: tuple[StandInTracker, ...]
    mapper: StandInMapper


def free_port() -> int:
    """A port of this host for a process that is about to start; see `free_ports`."""
    return free_ports(1)[0]


@contextmanager
def local_gateway(num_trackers: int = 1, *settings: str) -> Iterator[LocalGateway]:
    """Start everything; `settings` are key=value words of the gateway."""
    with ExitStack() as stack:
        router = f"tcp/127.0.0.1:{free_port()}"
        stack.callback(open_router(router, PATIENT_ROUTER).close)
        bus = stack.enter_context(open_bus([router], PATIENT_BUS))
        # Each on a connection of its own, as separate services are.
        trackers = tuple(
            StandInTracker(stack.enter_context(open_bus([router], PATIENT_BUS)), f"tracker-{i}")
            for i in range(num_trackers)
        )
        mapper = StandInMapper(stack.enter_context(open_bus([router], PATIENT_BUS)), "mapper-0")
        ports = (free_port(), free_port())
        process = stack.enter_context(gateway_process(router, ports, *settings))
        yield LocalGateway(
            url=f"http://127.0.0.1:{ports[0]}",
            grpc_address=f"127.0.0.1:{ports[1]}",
            router=router,
            pid=process.pid,
            bus=bus,
            trackers=trackers,
            mapper=mapper,
        )


@contextmanager
def gateway_process(
    router: str,
    ports: tuple[int, int],
    *settings: str,
    access: tuple[str, ...] = ("--insecure-local",),
) -> Iterator[subprocess.Popen[str]]:
    """A gateway process, from when it is ready until it has ended."""
    command = [sys.executable, "-m", "services.gateway", "--connect", router, *access]
    command += ["--http-port", str(ports[0]), "--grpc-port", str(ports[1])]
    command += [word for setting in (*PATIENCE[:1], *settings) for word in ("--set", setting)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True)
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line.startswith("READY"), line
        yield process
    finally:
        process.terminate()
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()
