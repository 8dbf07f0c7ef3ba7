"""The anchors of the map: N_v = {(p_v, f_v, l_v, O_v)} (paper Eq. 3), one row each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.anchors.quaternions import product, quat_wxyz_of
from services.mapping.anchors.rows import RowTable
from services.mapping.anchors.voxels import level_of, voxel_keys
from services.mapping.config import AnchorConfig
from shared import se3

FEATURES = 32
IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0])  # a quaternion, wxyz


def trained_widths(config: AnchorConfig) -> dict[str, int]:
    """Width of each column that is trained, for neural or plain Gaussians."""
    k = config.children
    if config.gaussians == "plain":
        return {"colours": 3 * k, "offsets": 3 * k, "opacities": k, "sizes": 3 * k, "turns": 4 * k}
    return {"features": FEATURES, "offsets": 3 * k, "scalings": 6}


@dataclass(frozen=True)
class NewAnchors:
    """Anchors to be added; rows of numpy arrays."""

    positions: NDArray[np.float32]  # p_v, [A, 3], world, metres
    features: NDArray[np.float32]  # f_v, [A, 32]
    offsets: NDArray[np.float32]  # O_v, [A, k * 3], in units of exp(scalings[:3])
    scalings: NDArray[np.float32]  # [A, 6], log metres: l_v of the offsets, then of the sizes
    keys: NDArray[np.int64]  # [A], the voxel that each one fills
    is_primary: NDArray[np.bool_]  # [A]

    def __len__(self) -> int:
        return len(self.positions)

    def take(self, index: NDArray[np.int64]) -> NewAnchors:
        """The rows of `index`."""
        return NewAnchors(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def finite(self) -> NewAnchors:
        """Those whose every number is one."""
        columns = (self.positions, self.features, self.offsets, self.scalings)
        is_finite = [np.isfinite(column).all(axis=1) for column in columns]
        return self.take(np.flatnonzero(np.logical_and.reduce(is_finite)))

    def first(self, count: int) -> NewAnchors:
        """At most `count` of them, primary ones first."""
        return self.take(np.argsort(~self.is_primary, kind="stable")[:count])


class AnchorMap:
    """All anchors with their optimizer state and statistics, on one device."""

    def __init__(self, config: AnchorConfig, device: torch.device, is_gated: bool = False) -> None:
        self.config = config
        self.device = device
        self.is_gated = is_gated  # opacities have a factor, the column `gate`
        gate = {"gate": ((), torch.float32)} if is_gated else {}
        self.rows = RowTable(_columns(config) | gate, device)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def num_primary(self) -> int:
        """How many anchors come from ORB points."""
        return int(self.rows["is_primary"].sum())

    @property
    def num_bytes(self) -> int:
        """Size of the map itself, without optimizer state."""
        widths = {"position": 3, "turn": 4, "scalings": 6} | trained_widths(self.config)
        return len(self) * 4 * sum(widths.values())

    def keys(self) -> NDArray[np.int64]:
        """The voxels that are taken, [N]."""
        return self.rows["key"].cpu().numpy()

    def heirs_features(self, index: Tensor) -> Tensor:
        """What anchors that grow from rows `index` start with, [N, 32]; plain ones have colours."""
        if self.config.gaussians == "neural":
            return self.rows["features"][index]
        colours = self.rows["colours"][index]
        return torch.nn.functional.pad(colours, (0, FEATURES - colours.shape[1]))

    def log_sizes(self, index: Tensor) -> Tensor:
        """Log of twice the children's usual sigma, metres, [N, 3]."""
        sizes = self.rows["scalings"][index, 3:]
        if self.config.gaussians == "neural":
            return sizes
        return sizes + self.rows["sizes"][index].view(-1, self.config.children, 3).mean(1)

    def add_to_logit_colours(self, index: Tensor, change: Tensor) -> None:
        """Add `change` [V, k * 3] to the logits that the colours of the children start from."""
        name = "colours" if self.config.gaussians == "plain" else "features"
        self.rows[name][index, : change.shape[1]] += change

    def append(self, new: NewAnchors, creator_seq: int) -> int:
        """Add anchors that keyframe `creator_seq` made, up to the cap; returns how many.

        Those that are not finite (a fault of a pose or a landmark) are left out.
        """
        new = new.finite().first(max(0, self.config.max_anchors - len(self)))
        if len(new) == 0:
            return 0
        is_primary = torch.from_numpy(new.is_primary)
        self.rows.append(
            {
                "position": torch.from_numpy(new.positions),
                "features": torch.from_numpy(new.features),
                "colours": torch.from_numpy(new.features[:, : 3 * self.config.children]),
                "offsets": torch.from_numpy(new.offsets),
                "scalings": torch.from_numpy(new.scalings),
                "key": torch.from_numpy(new.keys),
                "is_primary": is_primary,
                "gate": torch.ones(len(new)),
                "rate": torch.where(is_primary, self.config.primary_rate, 1.0),
                "creator": torch.full((len(new),), creator_seq, dtype=torch.int64),
                "turn": IDENTITY.expand(len(new), 4),
            }
        )
        return len(new)

    def keep(self, is_kept: Tensor) -> None:
        """Remove the anchors where `is_kept` [N] is false."""
        self.rows.keep(is_kept)

    def move(self, creator_seq: int, T_new_old: NDArray[np.float64]) -> None:
        """Take the anchors of a keyframe along with its correction.

        Positions and offsets turn with the keyframe. What the networks say of an anchor is said
        in a frame that turns with it, too: `turn` is that frame in the world.
        """
        index = torch.nonzero(self.rows["creator"] == creator_seq)[:, 0]
        R = torch.from_numpy(T_new_old[:3, :3]).to(self.rows["position"])
        positions = self.rows["position"][index].cpu().numpy()
        moved = se3.transform(T_new_old, positions.astype(np.float64))
        levels = level_of(self.rows["key"][index].cpu().numpy())
        keys = voxel_keys(moved, levels, self.config)
        self.rows["position"][index] = torch.from_numpy(moved).to(self.rows["position"])
        self.rows["key"][index] = torch.from_numpy(keys).to(self.device)
        sizes = self.rows["scalings"][index, None, :3].exp()
        offsets = self.rows["offsets"][index].view(-1, self.config.children, 3) * sizes
        self.rows["offsets"][index] = ((offsets @ R.T) / sizes).flatten(1)
        turn = product(quat_wxyz_of(T_new_old).to(self.device), self.rows["turn"][index])
        self.rows["turn"][index] = torch.nn.functional.normalize(turn, dim=1)

    def copy(self) -> AnchorMap:
        """What drawing needs of them, as it is now; without optimizer state and statistics."""
        drawn = {"position", "turn", "scalings", "creator", "gate", *trained_widths(self.config)}
        copied = AnchorMap(self.config, self.device, self.is_gated)
        copied.rows = self.rows.copy(drawn)
        return copied

    def state(self, room: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
        """All rows, for a snapshot; `room` is that of `rows.room()`."""
        return self.rows.state(room)

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Replace all rows; those of an older snapshot have never been turned."""
        count = len(state["position"])
        self.rows.restore({"turn": IDENTITY.expand(count, 4), **state})


def _columns(config: AnchorConfig) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
    children = config.children
    trained = {
        f"{name}{suffix}": ((width,), torch.float32)
        for name, width in trained_widths(config).items()
        for suffix in ("", "_mean", "_square")  # the value and Adam's moments
    }
    return {
        "scalings": ((6,), torch.float32),
        **trained,
        "position": ((3,), torch.float32),
        "turn": ((4,), torch.float32),
        "steps": ((), torch.int64),
        "rate": ((), torch.float32),
        "is_primary": ((), torch.bool),
        **({} if config.features in ("colours", "random") else {"seen": ((6,), torch.float32)}),
        "creator": ((), torch.int64),
        "key": ((), torch.int64),
        "opacity_sum": ((), torch.float32),
        "visits": ((), torch.float32),
        "gradient_sum": ((children,), torch.float32),
        "gradient_visits": ((children,), torch.float32),
    }
