"""Which earlier keyframes may show a keyframe's place: by where they look and by how it looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.mapping.keyframes.context import visible_shares
from services.mapping.keyframes.retrieval import count_alike, thumbnail_correlation
from services.mapping.keyframes.stored import StoredKeyframe
from shared.errors import ConfigError
from shared.se3 import rotate, transform


@dataclass(frozen=True)
class LoopCandidatesConfig:
    """What is worth a verification, which costs about as much as tracking a frame."""

    min_overlap: float = 0.3  # share of the keyframe's surface that the other one may see
    sure_overlap: float = 0.5  # enough without a likeness
    min_likeness: float = 0.4  # correlation of thumbnails, where the poses do not say so
    max_compared: int = 3  # by each of the two, whose descriptors are compared
    overlap_samples: int = 64
    max_descriptors: int = 500
    max_hamming_bits: int = 40
    min_alike: int = 12  # descriptors with a near one
    max_candidates: int = 2
    min_spacing: int = 5  # keyframes between two candidates

    def __post_init__(self) -> None:
        if min(self.max_compared, self.overlap_samples, self.max_candidates) < 1:
            raise ConfigError("loop.candidates: counts must be at least 1")


def loop_candidates(
    reference: StoredKeyframe, far: list[StoredKeyframe], config: LoopCandidatesConfig
) -> list[int]:
    """Seqs of the likeliest keyframes, best first; few or none.

    Args:
        reference: the keyframe whose place is looked for.
        far: keyframes that are far from it in the graph, in order of their seq.
        config: limits.
    """
    if not far:
        return []
    overlaps = _overlaps(reference, far, config)
    likeness = thumbnail_correlation(reference.thumbnail, np.stack([k.thumbnail for k in far]))
    compared = set(_best(overlaps, config.min_overlap, config.max_compared))
    compared |= set(_best(likeness, config.min_likeness, config.max_compared))
    alike = {i: _num_alike(reference, far[i], config) for i in sorted(compared)}
    likely = [
        i for i in alike if alike[i] >= config.min_alike or overlaps[i] >= config.sure_overlap
    ]
    chosen: list[int] = []
    for i in sorted(likely, key=lambda i: (-alike[i], -overlaps[i], i)):
        if all(abs(i - other) >= config.min_spacing for other in chosen):
            chosen.append(i)
    return [far[i].seq for i in chosen[: config.max_candidates]]


def _overlaps(
    reference: StoredKeyframe, far: list[StoredKeyframe], config: LoopCandidatesConfig
) -> np.ndarray:
    cloud, T = reference.cloud_camera, reference.T_world_camera
    step = max(1, len(cloud.points) // config.overlap_samples)
    points = transform(T, cloud.points[::step].astype(np.float64))
    return visible_shares(points, rotate(T, cloud.normals[::step].astype(np.float64)), far)


def _best(values: np.ndarray, minimum: float, count: int) -> list[int]:
    order = np.argsort(-values, kind="stable")[:count]
    return [int(i) for i in order if values[i] >= minimum]


def _num_alike(a: StoredKeyframe, b: StoredKeyframe, config: LoopCandidatesConfig) -> int:
    return count_alike(
        a.observations.descriptors,
        b.observations.descriptors,
        config.max_descriptors,
        config.max_hamming_bits,
    )
