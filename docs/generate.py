"""Writes the reference pages that are made of the code: settings, routes, metrics.

python docs/generate.py [FOLDER]        after a change of a setting, a route or a metric
"""

from __future__ import annotations

import importlib
import inspect
import io
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from prometheus_client import REGISTRY

from pointslam.datasets import SequenceOptions
from services.gateway.access.routes import GRPC, HTTP, Access
from services.gateway.config import GatewayConfig
from services.mapping.config import MappingConfig
from services.tracking.config import TrackingConfig
from shared.fabric import RouterConfig

FOLDER = Path(__file__).resolve().parent / "reference"
ROOTS = {
    "tracking": TrackingConfig(),
    "mapping": MappingConfig(),
    "gateway": GatewayConfig(),
    "router": RouterConfig(),
    "sequence": SequenceOptions(),
}
_MADE = "<!-- made by docs/generate.py; do not edit -->\n"


def main(folder: Path = FOLDER) -> None:
    """Write all pages."""
    (folder / "settings.md").write_text(settings_page())
    (folder / "routes.md").write_text(routes_page())
    (folder / "metrics.md").write_text(metrics_page())


def settings_page() -> str:
    """Every setting with its default and what its comment says."""
    lines = [
        f"{_MADE}# Settings",
        "",
        "Given as `--set KEY=VALUE` to `pointslam run` and `pointslam up`, many in a YAML file",
        "with `--config FILE`. A key that does not exist stops the start and lists those that do.",
    ]
    for role, config in ROOTS.items():
        lines += ["", f"## {role}", "", "| key | default | |", "|---|---|---|"]
        lines += [
            f"| `{key}` | `{_shown(default)}` | {text} |"
            for key, default, text in _settings(role, config)
        ]
    return "\n".join(lines) + "\n"


def routes_page() -> str:
    """Every route and RPC with the scopes that open it."""
    lines = [
        f"{_MADE}# Routes and the scopes that open them",
        "",
        "What each takes and answers is told, with examples, by a running gateway at `/docs`",
        "(HTTP) and in `proto/pointslam/v1` (gRPC, with reflection). A key opens a route if it has",
        "one of its scopes.",
        "",
        "| HTTP and WebSocket | scopes |",
        "|---|---|",
    ]
    lines += [f"| `{name}` | {_scopes(access)} |" for name, access in HTTP.items()]
    lines += ["", "| gRPC | scopes |", "|---|---|"]
    lines += [f"| `{name}` | {_scopes(access)} |" for name, access in GRPC.items()]
    return "\n".join(lines) + "\n"


def metrics_page() -> str:
    """Every metric of ours, by service."""
    lines = [
        f"{_MADE}# Metrics",
        "",
        "The gateway serves them at `/metrics`, trackers and mappers at the port of",
        "`--metrics-port`. Memory, processor time and open files of each process are there too.",
    ]
    known = {metric.name for metric in REGISTRY.collect()}
    for service in ("gateway", "tracking", "mapping"):
        module = importlib.import_module(f"services.{service}.metrics")
        if hasattr(module, "SessionCollector"):
            module.SessionCollector(list)
        lines += ["", f"## {service}", "", "| metric | type | labels | |", "|---|---|---|---|"]
        lines += [row for name, row in sorted(_metrics()) if name not in known]
        known |= {name for name, _ in _metrics()}
    return "\n".join(lines) + "\n"


def _settings(prefix: str, config: Any) -> Iterator[tuple[str, Any, str]]:
    """Key, default and comment of every setting below a group."""
    comments = _comments(type(config))
    for entry in fields(config):
        key, value = f"{prefix}.{entry.name}", getattr(config, entry.name)
        if is_dataclass(value):
            yield from _settings(key, value)
        else:
            yield key, value, comments.get(entry.name, "")


def _comments(kind: type) -> dict[str, str]:
    """What stands behind each field of a class; a comment goes on over the lines of its field."""
    found: dict[str, str] = {}
    name, depth = "", 0
    for token in tokenize.generate_tokens(io.StringIO(inspect.getsource(kind)).readline):
        if token.type == tokenize.NAME and token.line.startswith("    ") and depth == 0:
            words = token.line.split(":")
            if token.start[1] == 4 and len(words) > 1 and words[0].strip() == token.string:
                name = token.string
        elif token.type == tokenize.OP:
            depth += (token.string in "([{") - (token.string in ")]}")
        elif token.type == tokenize.COMMENT and name:
            found[name] = f"{found.get(name, '')} {token.string.lstrip('# ')}".strip()
    return found


def _shown(value: Any) -> str:
    return "" if value in (None, "") else str(value).replace("|", "\\|")


def _scopes(access: Access) -> str:
    if not access.scopes:
        return "open to all"
    names = " or ".join(sorted(str(scope) for scope in access.scopes))
    return f"{names}, or a ticket" if access.takes_ticket else names


def _metrics() -> Iterator[tuple[str, str]]:
    """Name and row of what is registered now; not what each process has anyway."""
    for collector in list(REGISTRY._collector_to_names):  # no public way to ask for labels
        for metric in getattr(collector, "describe", list)():
            if metric.name.startswith("pointslam_"):
                owner = collector if hasattr(collector, "_labelnames") else metric
                labels = ", ".join(getattr(owner, "_labelnames", ()))
                row = f"| `{metric.name}` | {metric.type} | {labels} | {metric.documentation} |"
                yield metric.name, row


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
