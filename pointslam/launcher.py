"""The services as processes on one machine: start, health, memory, stop."""

from __future__ import annotations

import socket
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

from pointslam.process import Command, ServiceProcess
from pointslam.settings import ServiceSettings
from shared.addresses import host_port
from shared.errors import ConfigError

START_TIMEOUT_S = 300.0  # the first start compiles every kernel
_STOP_TIMEOUT_S = 20.0
_HOST = "127.0.0.1"


@dataclass(frozen=True)
class Access:
    """Who may use the gateway: by default whoever is on this machine, else who has a key.

    Where the settings name an issuer of JSON web tokens, its tokens let in beside the keys.

    The files are those of `pointslam keys create` and of a certificate with its private key (PEM).
    """

    host: str = _HOST
    keys: Path | None = None
    tls_certificate: Path | None = None
    tls_key: Path | None = None

    def arguments(self, settings: ServiceSettings) -> tuple[str, ...]:
        """Words of the gateway's command line."""
        files = {
            "--keys": self.keys,
            "--tls-certificate": self.tls_certificate,
            "--tls-key": self.tls_key,
        }
        words = [word for name, file in files.items() if file for word in (name, str(file))]
        is_guarded = self.keys is not None or settings.has_jwt()
        return tuple(words) if is_guarded else ("--insecure-local", *words)

    def url(self, port: int) -> str:
        """Where the gateway is found from this machine."""
        scheme = "http" if self.tls_certificate is None else "https"
        host = _HOST if self.host in ("0.0.0.0", "::") else self.host
        return f"{scheme}://{host_port(host, port)}"


@dataclass(frozen=True)
class LaunchOptions:
    """What to start. Ports of 0 are chosen; `data` holds the sessions' maps."""

    data: Path
    logs: Path
    num_trackers: int = 2
    device: str = "auto"
    http_port: int = 0
    grpc_port: int = 0
    num_mappers: int = 1
    num_gateways: int = 1  # the first has the ports given, the others those that follow
    traces: str = ""  # where spans go, as the services' --traces
    access: Access = field(default_factory=Access)
    settings: ServiceSettings = field(default_factory=ServiceSettings)

    def __post_init__(self) -> None:
        wanted = {
            "tracker": self.num_trackers,
            "mapper": self.num_mappers,
            "gateway": self.num_gateways,
        }
        for role, number in wanted.items():
            if number < 1:
                raise ConfigError(f"at least 1 {role} is needed, got {number}")
        for name, port in (("http_port", self.http_port), ("grpc_port", self.grpc_port)):
            if not 0 <= port <= 65535:
                raise ConfigError(f"{name} must be 0 to 65535, got {port}")


class Services:
    """A router, a gateway, trackers and mappers; a context manager that stops them.

    Raises:
        UnavailableError: one of them did not start; holds the end of its log.
    """

    def __init__(self, options: LaunchOptions) -> None:
        count = options.num_gateways
        ports = free_ports(1 + 2 * count)
        self.http_ports = _ports(options.http_port, ports[1 : 1 + count])
        self.grpc_ports = _ports(options.grpc_port, ports[1 + count :])
        self.http_port, self.grpc_port = self.http_ports[0], self.grpc_ports[0]
        self.urls = [options.access.url(port) for port in self.http_ports]
        self.url = self.urls[0]
        router = options.settings.router_endpoint() or f"tcp/{_HOST}:{ports[0]}"
        self._processes: list[ServiceProcess] = []
        options.data.mkdir(parents=True, exist_ok=True)
        try:
            listen = Command("router", "router", "pointslam.router", _listen(options, router))
            deadline = time.monotonic() + START_TIMEOUT_S
            self._start(listen, options.logs).wait_ready(deadline)
            for command in self._commands(options, router):
                self._start(command, options.logs)
            for process in self._processes:
                process.wait_ready(deadline)
        except BaseException:
            self.stop()
            raise

    def __enter__(self) -> Services:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def processes(self) -> list[ServiceProcess]:
        """All processes, in the order of their start."""
        return list(self._processes)

    def check(self) -> None:
        """Raise UnavailableError, with the end of the log, if a process has ended."""
        for process in self._processes:
            process.check()

    def restart_ended(self) -> list[str]:
        """Start ended processes again; returns their names."""
        ended = [process for process in self._processes if not process.is_running()]
        for process in ended:
            process.restart()
        return [process.command.name for process in ended]

    def peak_rss_mb(self) -> dict[str, float]:
        """The most memory that each role ever held (summed over its processes), MB."""
        total: defaultdict[str, float] = defaultdict(float)
        for process in self._processes:
            total[process.command.role] += process.peak_rss_bytes() / 1e6
        return dict(total)

    def stop(self) -> None:
        """End all processes: gateways while what they ask still answers, the router last."""
        deadline = time.monotonic() + _STOP_TIMEOUT_S
        for roles in (("gateway",), ("tracking", "mapping"), ("router",)):
            ending = [each for each in self._processes if each.command.role in roles]
            for process in ending:
                process.terminate()
            for process in ending:
                process.wait(max(deadline - time.monotonic(), 5.0))
        self._processes.clear()

    def _start(self, command: Command, logs: Path) -> ServiceProcess:
        self._processes.append(ServiceProcess(command, logs))
        return self._processes[-1]

    def _commands(self, options: LaunchOptions, router: str) -> list[Command]:
        def command(role: str, name: str, *arguments: str) -> Command:
            settings = options.settings.arguments(role)
            common = ("--connect", router, "--id", name, "--traces", options.traces)
            return Command(name, role, f"services.{role}", (*common, *arguments, *settings))

        trackers = [f"tracker-{i}" for i in range(options.num_trackers)]
        mappers = [f"mapper-{i}" for i in range(options.num_mappers)]
        doors = [
            ("--http-host", options.access.host, "--http-port", str(http), "--grpc-port", str(grpc))
            for http, grpc in zip(self.http_ports, self.grpc_ports, strict=True)
        ]
        access = options.access.arguments(options.settings)
        data = ("--data", str(options.data), "--device", options.device)
        return [
            *(command("tracking", name) for name in trackers),
            *(command("mapping", name, *data) for name in mappers),
            *(command("gateway", f"gateway-{i}", *d, *access) for i, d in enumerate(doors)),
        ]


def _listen(options: LaunchOptions, router: str) -> tuple[str, ...]:
    settings = options.settings
    where = () if settings.router_endpoint() else ("--listen", router)
    return (*where, *settings.arguments("router"))


def _ports(first: int, free: list[int]) -> list[int]:
    return [first + i for i in range(len(free))] if first else free


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on, and that nobody else is given in the next minute."""
    return [_reserved_port() for _ in range(count)]


def _reserved_port() -> int:
    """A port with a connection that has just ended here.

    While that is remembered (TIME_WAIT), the kernel gives the port to nobody by itself, but to a
    service that asks for it by number: no other process that starts meanwhile can get it.
    """
    with socket.create_server((_HOST, 0)) as listener:
        port: int = listener.getsockname()[1]
        with socket.create_connection((_HOST, port)) as client:
            ended, _ = listener.accept()
            ended.close()  # first, so that it is this end that remembers
            client.recv(1)
    return port
