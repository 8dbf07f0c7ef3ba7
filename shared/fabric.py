"""What zenoh is told: who may connect, over what, and how much. The same for every process.

A router asks for a user and a password, for a certificate, or for nothing; with an access list
(`shared.access`) everybody may do what its role needs and nothing else. Secrets come from files or
from the environment: a command line is for everybody on the machine to read.
"""

from __future__ import annotations

import json
import os
import socket
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from shared.access import AccessConfig, access_control
from shared.errors import ConfigError

MAX_MESSAGE_BYTES = 256 << 20
PASSWORD_VARIABLE = "POINTSLAM_BUS_PASSWORD"
_LINK_PROBE_S = 1.0
_QUEUE_BATCHES = 16  # of 64 kB, for each connection and priority; zenoh takes no more
_AUTH, _TLS = "transport/auth/usrpwd", "transport/link/tls"


@dataclass(frozen=True)
class BusConfig:
    """How a process shows the routers who it is; certificates and keys are PEM files."""

    user: str = ""
    password_file: str = ""  # empty: the environment's POINTSLAM_BUS_PASSWORD
    root_certificate: str = ""  # who signs the others' certificates; for endpoints tls/host:port
    certificate: str = ""  # our own, with its key, for routers that ask for one
    private_key: str = ""
    lease_s: float = 2.0  # the others take a connection of ours that is silent for so long for dead

    def __post_init__(self) -> None:
        if bool(self.certificate) != bool(self.private_key):
            raise ConfigError("bus.certificate and bus.private_key belong together: one is missing")
        if self.lease_s <= 0.0:
            raise ConfigError(f"bus.lease_s must be positive, got {self.lease_s}")

    @property
    def is_named(self) -> bool:
        """Whether it says who the process is."""
        return bool(self.user or self.certificate)

    def who(self) -> str:
        """The process's name before the router, for people."""
        if self.user:
            return f"user {self.user!r}"
        return f"certificate {self.certificate}" if self.certificate else "nobody (no bus.user)"


@dataclass(frozen=True)
class RouterConfig:
    """A router: where it listens, whom it lets in, what they may do.

    With `bus.user` everybody needs a user of `users_file`; with `bus.root_certificate` a
    certificate signed by it. `access` names users or, without a file of them, certificates.
    """

    listen: tuple[str, ...] = ()
    routers: tuple[str, ...] = ()  # endpoints of the site's other routers
    bus: BusConfig = field(default_factory=BusConfig)
    users_file: str = ""  # lines user:password, the router's own among them
    access: AccessConfig = field(default_factory=AccessConfig)

    def __post_init__(self) -> None:
        if bool(self.users_file) != bool(self.bus.user):
            raise ConfigError("users_file and bus.user belong together: one is missing")
        has_names = self.users_file or self.bus.root_certificate
        if self.access.is_set and not has_names:
            raise ConfigError("access needs users_file or bus.root_certificate: who is who?")


def client_config(endpoints: list[str], bus: BusConfig) -> zenoh.Config:
    """zenoh's settings for a service.

    Raises:
        ConfigError: a file cannot be read, or zenoh does not take a value.
    """
    return _config(_common("client", endpoints, [], bus) | _credentials(bus))


def router_config(config: RouterConfig) -> zenoh.Config:
    """zenoh's settings for a router.

    Raises:
        ConfigError: as `client_config`.
    """
    bus = config.bus
    settings = _common("router", list(config.routers), list(config.listen), bus)
    settings |= _credentials(bus)
    if config.users_file:
        settings[f"{_AUTH}/dictionary_file"] = _file(config.users_file, "users_file")
    if bus.certificate:
        settings |= {
            f"{_TLS}/listen_certificate": bus.certificate,
            f"{_TLS}/listen_private_key": bus.private_key,
        }
    if config.access.is_set:
        names = "usernames" if config.users_file else "cert_common_names"
        settings["access_control"] = access_control(config.access, names)
    return _config(settings)


def answers(endpoints: list[str]) -> list[str]:
    """Those endpoints where something listens, whether it lets us in or not."""
    return [endpoint for endpoint in endpoints if _is_listening(endpoint)]


def _common(mode: str, connect: list[str], listen: list[str], bus: BusConfig) -> dict[str, Any]:
    """No scouting, no shared memory, short leases, bounded messages."""
    return {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/endpoints": connect,
        "connect/timeout_ms": 3000,
        # A router starts without its neighbours and finds them later.
        "connect/exit_on_failure": mode == "client",
        "connect/retry": {"period_max_ms": 1000},
        "listen/endpoints": listen,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": round(1e3 * bus.lease_s),
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # Room for a frame: who sends one waits for the link beyond it, were it an event loop.
        "transport/link/tx/queue/size/data": _QUEUE_BATCHES,
        "transport/link/tx/queue/size/data_low": _QUEUE_BATCHES,
    }


def _credentials(bus: BusConfig) -> dict[str, Any]:
    settings: dict[str, Any] = {}
    if bus.user:
        settings |= {f"{_AUTH}/user": bus.user, f"{_AUTH}/password": _password(bus)}
    if bus.root_certificate:
        root = _file(bus.root_certificate, "bus.root_certificate")
        settings[f"{_TLS}/root_ca_certificate"] = root
    if bus.certificate:
        settings |= {
            f"{_TLS}/connect_certificate": _file(bus.certificate, "bus.certificate"),
            f"{_TLS}/connect_private_key": _file(bus.private_key, "bus.private_key"),
            f"{_TLS}/enable_mtls": bool(bus.root_certificate),
        }
    return settings


def _password(bus: BusConfig) -> str:
    if bus.password_file:
        password = Path(_file(bus.password_file, "bus.password_file")).read_text().strip()
    else:
        password = os.environ.get(PASSWORD_VARIABLE, "")
    if not password:
        where = bus.password_file or f"neither bus.password_file nor {PASSWORD_VARIABLE}"
        raise ConfigError(f"bus.user is {bus.user!r}, but {where} holds its password")
    return password


def _file(path: str, setting: str) -> str:
    try:
        Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(f"{setting}: {path}: {error.strerror or error}") from None
    return path


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise ConfigError(f"zenoh does not take {key}: {str(error)[:200]}") from None
    return config


def _is_listening(endpoint: str) -> bool:
    host, _, port = endpoint.partition("/")[2].partition("?")[0].partition("#")[0].rpartition(":")
    if not port.isdecimal():
        return False
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=_LINK_PROBE_S):
            return True
    except OSError:
        return False
