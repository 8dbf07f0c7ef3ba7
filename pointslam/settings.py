"""Settings of a run: one file and `--set` words for all services and for reading the sequence.

The first part of a key says whose it is: tracking, mapping, gateway, router or sequence.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pointslam.datasets.base import SequenceOptions
from shared.config import override, read_overrides
from shared.errors import ConfigError

ROLES = ("tracking", "mapping", "gateway", "router")
_SEQUENCE = "sequence"


@dataclass(frozen=True)
class ServiceSettings:
    """Overrides by role, nested as the role's configuration is."""

    by_role: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def words(self) -> tuple[str, ...]:
        """`role.key=value` words that `read_settings` takes."""
        return tuple(f"{key}={json.dumps(value)}" for key, value in _flat(self.by_role))

    def router_endpoint(self) -> str | None:
        """Where the router listens, if the settings say so."""
        listen = self.by_role.get("router", {}).get("listen")
        return str(listen[0]) if isinstance(listen, list) and listen else None

    def has_jwt(self) -> bool:
        """Whether the gateway shall take an issuer's tokens."""
        below: Any = self.by_role.get("gateway", {})
        for part in ("access", "jwt", "key_file"):
            below = below.get(part) if isinstance(below, Mapping) else None
        return bool(below)

    def arguments(self, role: str) -> list[str]:
        """`--set key=value` words for a service's command line."""
        words = []
        for key, value in _flat(self.by_role.get(role, {})):
            words += ["--set", f"{key}={json.dumps(value)}"]
        return words


@dataclass(frozen=True)
class RunSettings:
    """Everything that --config and --set can change."""

    services: ServiceSettings = field(default_factory=ServiceSettings)
    sequence: SequenceOptions = field(default_factory=SequenceOptions)


def read_settings(file: Path | None, assignments: Iterable[str]) -> RunSettings:
    """Read a YAML file and `role.key=value` words, the words last.

    Raises:
        ConfigError: a key starts with no known part, or a sequence setting does not fit. What a
            service does not know, it says itself when it starts.
    """
    changes = read_overrides(file, assignments)
    known = (*ROLES, _SEQUENCE)
    for part, below in changes.items():
        if part not in known:
            raise ConfigError(f"unknown setting {part}; a key starts with {', '.join(known)}")
        if not isinstance(below, Mapping):
            raise ConfigError(f"{part} is a group of settings, got {below!r}")
    sequence = override(SequenceOptions(), changes.pop(_SEQUENCE, {}), f"{_SEQUENCE}.")
    return RunSettings(ServiceSettings(changes), sequence)


def _flat(changes: Mapping[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in changes.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{where}{key}.")
        else:
            yield f"{where}{key}", value
