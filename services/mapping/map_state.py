"""A map's state as named tensors and plain values: what a snapshot holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class MapState:
    """`tensors` by dotted name; `values` is what JSON can hold."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]


def flatten(groups: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Groups of tensors under the names `group.name`."""
    return {f"{group}.{name}": t for group, ts in groups.items() for name, t in ts.items()}


def unflatten(tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """The groups that `flatten` joined."""
    groups: dict[str, dict[str, Tensor]] = {}
    for dotted, tensor in tensors.items():
        group, _, name = dotted.partition(".")
        groups.setdefault(group, {})[name] = tensor
    return groups


def as_tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Copies of numpy arrays as tensors."""
    return {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}


def as_arrays(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Tensors of the host as numpy arrays."""
    return {name: tensor.numpy() for name, tensor in tensors.items()}
