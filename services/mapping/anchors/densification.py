"""Growing and culling of secondary anchors (Scaffold-GS, section 3.3, on our voxels)."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.anchors.anchor_map import AnchorMap, NewAnchors
from services.mapping.anchors.membership import is_among
from services.mapping.anchors.voxels import MIN_LEVEL, centres, level_of, sizes_m, voxel_keys
from services.mapping.config import AnchorConfig, DensificationConfig

_CHILD_SPREAD = 0.25  # of a voxel: new children around their parent child
_SHRINK = 1.6  # sigma of a grown child, of its parent's: 1 / 1.6, as 3DGS splits


def record(
    anchors: AnchorMap, index: Tensor, opacities: Tensor, gradient_norms: Tensor | None
) -> None:
    """Add one iteration to the statistics of the anchors it saw.

    Args:
        index: rows of the map, [V].
        opacities: of their children, [V * k].
        gradient_norms: of the children's projected means, [V * k]; 0 where not seen.
    """
    rows, count = anchors.rows, len(index)
    rows["opacity_sum"].index_add_(0, index, opacities.view(count, -1).mean(1))
    rows["visits"].index_add_(0, index, torch.ones_like(index, dtype=torch.float32))
    if gradient_norms is not None:
        norms = gradient_norms.view(count, -1)
        rows["gradient_sum"].index_add_(0, index, norms)
        rows["gradient_visits"].index_add_(0, index, (norms > 0).float())


def cull(anchors: AnchorMap, config: DensificationConfig) -> int:
    """Remove secondary anchors whose children hardly show; starts a new count. Returns how many."""
    rows = anchors.rows
    is_faint = rows["opacity_sum"] < config.cull_opacity * rows["visits"]
    is_judged = rows["visits"] > config.cull_visits
    is_culled = is_faint & is_judged & ~rows["is_primary"]
    rows["opacity_sum"].zero_()
    rows["visits"].zero_()
    if bool(is_culled.any()):
        rows.keep(~is_culled)
    return int(is_culled.sum())


def grow(
    anchors: AnchorMap,
    config: DensificationConfig,
    placement: AnchorConfig,
    rng: np.random.Generator,
) -> int:
    """New anchors, in voxels of half the size, around the children with the largest gradients.

    Returns how many. The statistics start anew.
    """
    rows = anchors.rows
    visits = rows["gradient_visits"]
    means = rows["gradient_sum"] / visits.clamp_min(1.0)
    means[visits < config.min_visits] = 0.0
    count = min(int(config.grow_share * len(anchors)), int((means > 0).sum()))
    chosen = means.flatten().topk(count).indices
    k = visits.shape[1]
    parents, children = (chosen // k).cpu().numpy(), (chosen % k).cpu().numpy()
    new = _around(anchors, parents, children, placement, rng)
    creators = rows["creator"].cpu().numpy()[parents]
    if anchors.is_gated:
        is_free = _halve_occupants(anchors, new.keys, placement)
        new, creators = new.take(np.flatnonzero(is_free)), creators[is_free]
    added = _append_by_creator(anchors, new, creators)
    for name in ("gradient_sum", "gradient_visits"):
        anchors.rows[name].zero_()
    return added


def _halve_occupants(
    anchors: AnchorMap, keys: NDArray[np.int64], placement: AnchorConfig
) -> NDArray[np.bool_]:
    """The paper's rule: "if a secondary anchor point already exists, its opacity is halved".

    Networks have no opacity to halve, so it is a gate behind them. Where nothing asks for it any
    more, it opens again; `cull` sees to the anchors that have become faint.

    Returns which of the voxels `keys` [A], that ask for an anchor, hold the centre of none.
    """
    rows = anchors.rows
    positions, levels = rows["position"].cpu().numpy(), level_of(keys)
    is_asked, is_free = np.zeros(len(anchors), bool), np.ones(len(keys), bool)
    for level in np.unique(levels):
        present = voxel_keys(positions, np.full(len(positions), level), placement)
        is_asked |= is_among(present, keys)
        is_free &= ~is_among(keys, present)
    is_halved = torch.from_numpy(is_asked).to(anchors.device) & ~rows["is_primary"]
    rows["gate"].copy_((rows["gate"] * torch.where(is_halved, 0.5, 2.0)).clamp_max(1.0))
    return is_free


def _around(
    anchors: AnchorMap,
    parents: NDArray[np.int64],
    children: NDArray[np.int64],
    config: AnchorConfig,
    rng: np.random.Generator,
) -> NewAnchors:
    """One anchor for each (parent, child); not yet sorted out by voxel."""
    at = torch.from_numpy(parents).to(anchors.device)
    offsets, scalings, positions, keys = (
        anchors.rows[name][at].cpu().numpy() for name in ("offsets", "scalings", "position", "key")
    )
    own = offsets.reshape(len(parents), config.children, 3)[np.arange(len(parents)), children]
    points = positions + own * np.exp(scalings[:, :3])
    levels = np.maximum(level_of(keys) - 1, MIN_LEVEL)
    sides = sizes_m(levels, config)[:, None]
    grown = centres(points, levels, config)
    spread = rng.normal(0.0, _CHILD_SPREAD, (len(parents), config.children, 3))
    new_offsets = ((points - grown) / sides)[:, None] + spread
    sizes = np.minimum(anchors.log_sizes(at).cpu().numpy() - math.log(_SHRINK), np.log(sides))
    return NewAnchors(
        positions=grown,
        features=anchors.heirs_features(at).cpu().numpy(),
        offsets=new_offsets.reshape(len(parents), 3 * config.children).astype(np.float32),
        scalings=np.concatenate([np.repeat(np.log(sides), 3, 1), sizes], 1).astype(np.float32),
        keys=voxel_keys(points, levels, config),
        is_primary=np.zeros(len(parents), bool),
    )


def _append_by_creator(anchors: AnchorMap, new: NewAnchors, creators: NDArray[np.int64]) -> int:
    """Add those whose voxel is free, each moving with its parent's keyframe from now on."""
    _, first = np.unique(new.keys, return_index=True)
    free = first[~is_among(new.keys[first], anchors.keys())]
    added = 0
    for creator in np.unique(creators[free]):
        added += anchors.append(new.take(free[creators[free] == creator]), int(creator))
    return added
