"""What a client says to create a session."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.gateway.access.tenants import SESSION_NAME
from services.gateway.decode import matrix_of
from shared.camera import Calibration
from shared.errors import InputError
from shared.se3 import Pose

MODES = ("live", "offline")
_MAX_SEED = 1 << 31


@dataclass(frozen=True)
class CreateRequest:
    """A session that is to be."""

    calibration: Calibration
    name: str | None = None
    mode: str = "live"
    seed: int = 0
    T_map_first: Pose | None = None

    def check(self) -> None:
        """Refuse what cannot be used with an InputError that names the field."""
        self.calibration.check()
        if self.name is not None and not SESSION_NAME.fullmatch(self.name):
            raise InputError("name", "must be 1 to 64 letters, digits, '-' or '_'")
        if self.mode not in MODES:
            raise InputError("mode", f"must be one of {', '.join(MODES)}, got {self.mode[:40]!r}")
        if not 0 <= self.seed < _MAX_SEED:
            raise InputError("seed", f"must be 0 to {_MAX_SEED - 1}, got {self.seed}")

    def T_world_first(self) -> np.ndarray:
        """The pose of the first frame, [4, 4]."""
        if self.T_map_first is None:
            return np.eye(4)
        return matrix_of(self.T_map_first, "T_map_first")
