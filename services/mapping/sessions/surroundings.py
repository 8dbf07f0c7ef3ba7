"""What a session needs of the process it runs in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from services.mapping.config import MappingConfig
from shared.tracks import Advanced, KeyframePoses


@dataclass(frozen=True)
class Surroundings:
    """The mapper's name, settings and device, and its way to tell news."""

    mapper: str  # the process's name
    config: MappingConfig
    device: torch.device
    publish: Callable[[str, KeyframePoses | Advanced], None]  # key, news
