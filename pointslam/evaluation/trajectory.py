"""Trajectory errors as the field computes them.

ATE: positions after an SE(3) alignment of the whole trajectory (Umeyama, no scale), by evo. RPE:
the motion over a fixed number of frames, against the true one. Estimates and truths belong
together by index; nothing is associated by time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from evo.core import geometry
from numpy.typing import NDArray

from shared import se3
from shared.se3 import Matrix

RPE_FRAMES = 30
_MIN_POSES = 3

Poses = Mapping[int, Matrix]  # frame index to T_world_camera


@dataclass(frozen=True)
class AbsoluteErrors:
    """Distances between estimated and true positions after alignment."""

    T_truth_map: Matrix  # brings estimated poses into the truth's world
    indices: NDArray[np.int64]  # [N] frames compared
    errors_m: NDArray[np.float64]  # [N]

    @property
    def rmse_m(self) -> float:
        """Root mean square."""
        return float(np.sqrt(np.mean(self.errors_m**2)))

    @property
    def mean_m(self) -> float:
        """Mean: what SplaTAM and GS-ICP SLAM print as RMSE."""
        return float(np.mean(self.errors_m))


@dataclass(frozen=True)
class RelativeErrors:
    """Errors of the motion over RPE_FRAMES frames, by the pair's first frame."""

    indices: NDArray[np.int64]  # [N]
    translations_m: NDArray[np.float64]  # [N]
    rotations_deg: NDArray[np.float64]  # [N]

    @property
    def translation_rmse_m(self) -> float:
        """Root mean square of the translation's length."""
        return float(np.sqrt(np.mean(self.translations_m**2)))

    @property
    def rotation_rmse_deg(self) -> float:
        """Root mean square of the rotation's angle."""
        return float(np.sqrt(np.mean(self.rotations_deg**2)))


def absolute_errors(estimated: Poses, truth: Poses) -> AbsoluteErrors | None:
    """ATE of the frames that both know; None for fewer than three."""
    indices = sorted(estimated.keys() & truth.keys())
    if len(indices) < _MIN_POSES:
        return None
    ours = np.array([estimated[i] for i in indices])
    theirs = np.array([truth[i] for i in indices])
    T = align(ours, theirs)
    errors = np.linalg.norm(se3.transform(T, ours[:, :3, 3]) - theirs[:, :3, 3], axis=1)
    return AbsoluteErrors(T, np.array(indices), errors)


def align(estimated: NDArray[np.float64], truth: NDArray[np.float64]) -> Matrix:
    """`T_truth_map` that fits positions best, without scale; both [N, 4, 4].

    A camera that stays in place or moves on a line leaves the rotation open: then the first pose
    is made to agree.
    """
    try:
        rotation, translation, _ = geometry.umeyama_alignment(
            estimated[:, :3, 3].T, truth[:, :3, 3].T, with_scale=False
        )
    except geometry.GeometryException:
        return truth[0] @ se3.inverse(estimated[0])
    return se3.from_rotation(rotation, translation)


def relative_errors(
    estimated: Poses, truth: Poses, frames: int = RPE_FRAMES
) -> RelativeErrors | None:
    """RPE over all pairs (i, i + frames) that both know; None if there is none."""
    known = estimated.keys() & truth.keys()
    indices = sorted(i for i in known if i + frames in known)
    if not indices:
        return None
    errors = [
        se3.inverse(_motion(truth, i, frames)) @ _motion(estimated, i, frames) for i in indices
    ]
    lengths = np.array([np.linalg.norm(error[:3, 3]) for error in errors], np.float64)
    angles = np.rad2deg([se3.angle_rad(error) for error in errors])
    return RelativeErrors(np.array(indices), lengths, angles)


def _motion(poses: Poses, index: int, frames: int) -> Matrix:
    return se3.inverse(poses[index]) @ poses[index + frames]
