"""What in a frame moves otherwise than the map: with the camera, or through its free space.

A body fixed to the camera keeps its pixels and its depth while the map goes by: to the pose it
says that the camera stands still, and as a part of the map it would say so for good. A body that
moves by itself comes to where the map was seen to be empty. What was found to move is told to the
map as features without a landmark: while they stay in place, so does what they are on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.tracking.carried import StandingStill, standing_still, still_px
from services.tracking.config import MovingConfig
from services.tracking.local_map import LocalMap
from services.tracking.observed import Observed
from services.tracking.surfaces import Surfaces
from shared.se3 import inverse

_POINT_STEP = 4  # most of a surface needs not all of its points


@dataclass(frozen=True)
class Moving:
    """Surfaces that may move otherwise than the map, and why."""

    mask: NDArray[np.bool_]  # [H, W]
    is_intruding: bool  # some of them stand in the map's free space
    still: StandingStill  # features that may be carried along

    def is_confirmed(
        self, T_world_camera: NDArray[np.float64], observed: Observed, config: MovingConfig
    ) -> bool:
        """Whether the rest of the frame says so too: what stands still there ought to move."""
        moves_px = self.still.moves_px(T_world_camera, observed.intrinsics)
        limit_px = 2.0 * still_px(observed.intrinsics, config)
        return self.is_intruding or (len(moves_px) > 0 and float(np.median(moves_px)) > limit_px)


def find_moving(
    observed: Observed, local: LocalMap, T_world_camera: NDArray[np.float64], config: MovingConfig
) -> Moving | None:
    """Surfaces that go with the camera or stand in free space; None: too few to matter.

    What stands still in the image is carried along only if it is nearer than the rest: of two
    things that move against each other the one in front is not the world.

    Args:
        observed: the frame.
        local: the map around it.
        T_world_camera: its pose as far as it is known, [4, 4].
        config: thresholds.
    """
    surfaces = observed.surfaces.result()
    still = standing_still(observed, local.seen, config)
    stays = _staying(observed, surfaces, still, config)
    if stays.any() and surfaces.median_m(stays) >= surfaces.median_m(~stays):
        stays[:] = False
    intrudes = _intruding(observed, surfaces, local, T_world_camera, config)
    mask = _mask(observed, surfaces, stays | intrudes, config)
    return None if mask is None else Moving(mask, bool(intrudes.any()), still)


def known_moving(
    observed: Observed, local: LocalMap, config: MovingConfig
) -> NDArray[np.bool_] | None:
    """Pixels [H, W] of what moved in a keyframe and is where it was in the image; None: nothing.

    It goes with the camera, or the camera stands still and needs it as little.
    """
    if len(local.seen_moving.depths_m) < config.min_still:
        return None
    surfaces = observed.surfaces.result()
    still = standing_still(observed, local.seen_moving, config)
    return _mask(observed, surfaces, _staying(observed, surfaces, still, config), config)


def _mask(
    observed: Observed, surfaces: Surfaces, chosen: NDArray[np.bool_], config: MovingConfig
) -> NDArray[np.bool_] | None:
    """Pixels of the chosen surfaces, [H, W]; None where they are too few or leave too little."""
    share = surfaces.areas()[chosen].sum()
    if not config.min_share <= share <= config.max_share:
        return None
    return surfaces.mask(chosen, observed.depth_m.shape)


def _staying(
    observed: Observed, surfaces: Surfaces, still: StandingStill, config: MovingConfig
) -> NDArray[np.bool_]:
    """Surfaces whose features are where a keyframe saw them, [count]."""
    features = observed.features
    num_still = surfaces.counts(still.keypoints_px)
    num_all = surfaces.counts(features.keypoints_px[features.depths_m > 0.0])
    return (num_still >= config.min_still) & (num_still >= config.min_still_share * num_all)


def _intruding(
    observed: Observed,
    surfaces: Surfaces,
    local: LocalMap,
    T_world_camera: NDArray[np.float64],
    config: MovingConfig,
) -> NDArray[np.bool_]:
    """Surfaces most of whose points stand in free space, of those of which it is known, [count]."""
    points, i = observed.cloud.points[::_POINT_STEP], observed.intrinsics
    T_reference_world = inverse(local.context.T_world_reference)
    verdicts = local.free_space.verdicts(points, T_reference_world @ T_world_camera)
    judged = points[verdicts != 0]
    pixels = judged[:, :2] / judged[:, 2:] * [i.fx, i.fy] + [i.cx, i.cy]
    num_judged = surfaces.counts(pixels)
    num_free = surfaces.counts(pixels[verdicts[verdicts != 0] > 0])
    return (num_free >= config.min_free) & (num_free >= config.min_free_share * num_judged)
