"""A line of JSON for each admin action and each refusal; never what was shown as a key."""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path

from services.gateway.access.caller import Caller
from shared.api_keys import key_id
from shared.errors import ConfigError, PointSlamError

LOGGER = logging.getLogger("pointslam.audit")


def log_to(file: Path) -> None:
    """Write the audit log to a file of its own, readable by its owner alone.

    Raises:
        ConfigError: it cannot be written.
    """
    try:
        file.touch(mode=0o600)
        handler = logging.FileHandler(file)
    except OSError as error:
        raise ConfigError(f"--audit-log {file}: {error.strerror}") from None
    handler.setFormatter(logging.Formatter("%(message)s"))
    LOGGER.addHandler(handler)
    LOGGER.propagate = False


def refused(error: PointSlamError, action: str, client: str, authorization: str) -> None:
    """Somebody was not let in."""
    _write(
        {
            "event": "refused",
            "code": error.code,
            "reason": str(error),
            "action": action,
            "client": client,
            "key": key_id(authorization.rpartition(" ")[2]),
        }
    )


def acted(caller: Caller, action: str, client: str, outcome: str) -> None:
    """An admin has done something, or tried to."""
    who = {"key": caller.id, "tenant": caller.tenant, "client": client}
    _write({"event": "admin", **who, "action": action, "outcome": outcome})


def _write(entry: dict[str, object]) -> None:
    stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    LOGGER.info("%s", json.dumps({"time": stamp, **entry}))
