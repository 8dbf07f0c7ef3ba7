"""What happens to landmarks: corrections of the adjustment, moves of keyframes, mergers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.mapping.anchors.membership import is_among
from services.mapping.keyframes.stored import LandmarkTable
from shared.se3 import rotate, transform
from shared.tracks import KEYPOINT_BITS, NO_LANDMARK, KeyframeData, Observations


def corrected(
    table: LandmarkTable, data: KeyframeData, normals_world: NDArray[np.float32]
) -> LandmarkTable:
    """The table with the correction's positions; ids that it lacks are added with their normals."""
    correction = data.correction
    rows = table.rows(correction.landmark_ids)
    is_new = rows < 0
    positions = table.positions_world.copy()
    positions[rows[~is_new]] = correction.positions_world[~is_new]
    new_ids, first = np.unique(correction.landmark_ids[is_new], return_index=True)
    normals = np.zeros((len(new_ids), 3), np.float32)
    if len(new_ids):
        observed = data.observations.landmark_ids
        at = np.minimum(np.searchsorted(new_ids, observed), len(new_ids) - 1)
        mine = np.flatnonzero(new_ids[at] == observed)
        normals[at[mine]] = normals_world[mine]
    ids = np.concatenate([table.ids, new_ids])
    order = np.argsort(ids, kind="stable")
    new_positions = correction.positions_world[is_new][first]
    return LandmarkTable(
        ids=ids[order],
        positions_world=np.concatenate([positions, new_positions])[order],
        normals_world=np.concatenate([table.normals_world, normals])[order],
    )


def moved(table: LandmarkTable, T_new_old: Mapping[int, NDArray[np.float64]]) -> LandmarkTable:
    """Each landmark goes along with the keyframe that founded it, by that one's seq."""
    positions, normals = table.positions_world.copy(), table.normals_world.copy()
    founders = table.ids >> KEYPOINT_BITS
    starts = np.flatnonzero(np.diff(founders, prepend=-1))
    ends = np.append(starts[1:], len(founders))
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        T = T_new_old.get(int(founders[start]))
        if T is not None:
            positions[start:end] = transform(T, positions[start:end])
            normals[start:end] = rotate(T, normals[start:end])
    return LandmarkTable(table.ids, positions, normals)


def without(table: LandmarkTable, ids: NDArray[np.int64]) -> LandmarkTable:
    """The table without some landmarks."""
    keep = ~is_among(table.ids, ids)
    return LandmarkTable(table.ids[keep], table.positions_world[keep], table.normals_world[keep])


def renamed(observations: Observations, pairs: NDArray[np.int64]) -> Observations:
    """Observations of landmarks that turned out to be others, pairs of (id to keep, id to drop).

    Where both are observed already, the one to drop stays: it is no longer anyone's landmark.

    Args:
        observations: of a keyframe.
        pairs: [P, 2], by ascending id to drop.
    """
    ids = observations.landmark_ids
    if len(pairs) == 0:
        return observations
    at = np.minimum(np.searchsorted(pairs[:, 1], ids), len(pairs) - 1)
    is_dropped = (pairs[at, 1] == ids) & ~is_among(pairs[at, 0], ids)
    if not is_dropped.any():
        return observations
    return replace(observations, landmark_ids=np.where(is_dropped, pairs[at, 0], ids))


def dropped(observations: Observations, ids: NDArray[np.int64]) -> Observations:
    """Observations that are of none of the given landmarks."""
    is_dropped = is_among(observations.landmark_ids, ids)
    kept = np.where(is_dropped, np.int64(NO_LANDMARK), observations.landmark_ids)
    return replace(observations, landmark_ids=kept)


def one_to_one(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs in which no id appears twice, by ascending id to drop, [P, 2]."""
    _, first = np.unique(pairs[:, 1], return_index=True)
    pairs = pairs[first]
    _, first = np.unique(pairs[:, 0], return_index=True)
    pairs = pairs[np.sort(first)]
    return pairs[~is_among(pairs[:, 1], pairs[:, 0])]
