"""How exact a truth is: pairs of frames registered by their depth alone, from two starts.

Each pair is registered twice, from the truth's motion and from the tracker's. Where both starts end
at the same motion, what is left between it and a trajectory is that trajectory's error (and the
depth's). The residual says how far apart the two surfaces are under each motion.

python -m benchmarks.truth SEQUENCE... [--gap 30] [--step 1]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.tracking_run import Folder, track_all
from services.tracking.config import RegistrationConfig, SurfaceConfig, TrackingConfig
from services.tracking.point_cloud import surface_from_depth
from services.tracking.registration import align, linearise
from services.tracking.voxel_map import VoxelMap, build_voxel_map
from shared.rectify import rectify
from shared.se3 import angle_rad, inverse
from shared.tracks import PointCloud

_SURFACE = SurfaceConfig(stride_px=2)  # four times the tracker's points
_REGISTRATION = RegistrationConfig(
    voxel_sizes_m=(0.12, 0.06, 0.03),
    sample_steps=(8, 4, 2),
    max_iterations=(20, 20, 40),
    tolerances=(5e-4, 2e-4, 2e-5),
)
_MIN_OVERLAP = 0.5
Motions = list[NDArray[np.float64]]


@dataclass(frozen=True)
class Pair:
    """Motions [4, 4] of one pair of frames, and how far apart the surfaces are under each."""

    true: NDArray[np.float64]
    tracked: NDArray[np.float64]
    from_true: NDArray[np.float64]  # registered from there
    from_tracked: NDArray[np.float64]
    residuals_mm: tuple[float, float, float, float]  # in the order above
    overlap: float


def measure(folder: Folder, gap: int, step: int) -> list[Pair]:
    """Every pair of frames `gap` apart whose surfaces overlap by half."""
    indices = list(range(len(folder)))
    tracked = track_all(folder, indices, TrackingConfig())
    assert tracked.has_pose.all()
    poses = tracked.final_poses()
    truth = np.stack([folder.true_pose(index) for index in indices])
    pairs: list[Pair] = []
    for i in range(0, len(indices) - gap, step):
        earlier, later = _surface(folder, i), _surface(folder, i + gap)
        true, ours = (inverse(p[i]) @ p[i + gap] for p in (truth, poses))
        pair = register_pair(earlier, later, true, ours)
        if pair.overlap >= _MIN_OVERLAP:
            pairs.append(pair)
    return pairs


def _surface(folder: Folder, index: int) -> PointCloud:
    image = rectify(folder.frame(index), folder.calibration)
    return surface_from_depth(image.depth_m, image.intrinsics, _SURFACE)


def register_pair(
    earlier: PointCloud, later: PointCloud, true: NDArray[np.float64], tracked: NDArray[np.float64]
) -> Pair:
    """Register the later surface to the earlier one, from the truth's motion and the tracker's."""
    target = build_voxel_map(earlier, _REGISTRATION.voxel_sizes_m)
    from_true = align(later, target, true.copy(), _REGISTRATION)
    from_tracked = align(later, target, tracked.copy(), _REGISTRATION)
    motions = (true, tracked, from_true.T_world_camera, from_tracked.T_world_camera)
    a, b, c, d = (_residual_mm(later, target, T) for T in motions)
    return Pair(*motions, (a, b, c, d), min(from_true.overlap, from_tracked.overlap))


def _residual_mm(source: PointCloud, target: VoxelMap, T: NDArray[np.float64]) -> float:
    """Robust standard deviation of the distance between the surfaces, of a point 2 m away."""
    sigmas = linearise(source, target.levels[-1], T.copy(), _REGISTRATION).residual_scale
    sigma_m = _REGISTRATION.depth_sigma_floor_m + 4.0 * _REGISTRATION.depth_sigma_per_m2
    return 1e3 * sigmas * sigma_m


def _difference(a: Motions, b: Motions) -> str:
    """Root mean squares between two lists of motions."""
    steps = [inverse(x) @ y for x, y in zip(a, b, strict=True)]
    metres = np.sqrt(np.mean([np.square(step[:3, 3]).sum() for step in steps]))
    degrees = np.sqrt(np.mean([np.degrees(angle_rad(step)) ** 2 for step in steps]))
    return f"{1e3 * metres:6.1f} mm {degrees:6.3f} deg"


def _print(name: str, pairs: list[Pair]) -> None:
    true, ours = [p.true for p in pairs], [p.tracked for p in pairs]
    from_true, from_ours = [p.from_true for p in pairs], [p.from_tracked for p in pairs]
    a, b, c, d = np.median([p.residuals_mm for p in pairs], axis=0)
    print(f"{name}: {len(pairs)} pairs")
    print(f"  tracker to truth                          {_difference(true, ours)}")
    print(f"  registered from either                    {_difference(from_true, from_ours)}")
    print(f"  truth to what is registered from it       {_difference(true, from_true)}")
    print(f"  tracker to what is registered from it     {_difference(ours, from_ours)}")
    print(f"  tracker to what is registered from truth  {_difference(ours, from_true)}")
    print(f"  residual mm: truth {a:.2f}, tracker {b:.2f}, registered {c:.2f} and {d:.2f}")


def main(argv: list[str]) -> int:
    """Print the differences for the folders named in argv."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", nargs="+", type=Path)
    parser.add_argument("--gap", type=int, default=30, help="frames between the two of a pair")
    parser.add_argument("--step", type=int, default=1, help="frames between pairs")
    arguments = parser.parse_args(argv)
    cv2.setNumThreads(1)
    for path in arguments.sequences:
        _print(path.name, measure(Folder(path), arguments.gap, arguments.step))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
