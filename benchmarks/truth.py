"""How exact a truth is: pairs of frames registered by their depth alone, from two starts.

Each pair is registered twice, from the truth's motion and from the tracker's. Where both starts end
at the same motion, what is left between it and a trajectory is that trajectory's error (and the
depth's). The residual says how far apart the two surfaces are under each motion, in millimetres,
and how far apart the two images are where both show the same surface, in grey levels of 255.

python -m benchmarks.truth SEQUENCE... [--gap 30] [--step 1]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.tracking_run import track_all
from benchmarks.true_sequence import TrueSequence
from services.tracking.config import RegistrationConfig, SurfaceConfig, TrackingConfig
from services.tracking.point_cloud import surface_from_depth
from services.tracking.registration import align, linearise
from services.tracking.voxel_map import VoxelMap, build_voxel_map
from shared.rectify import RgbdImage, rectify
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
_SAME_SURFACE = 0.05  # of the depth, and 2 cm: the other image shows it too
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
    grey: tuple[float, float] = (0.0, 0.0)  # under the first two


def measure(sequence: TrueSequence, gap: int, step: int) -> list[Pair]:
    """Every pair of frames `gap` apart whose surfaces overlap by half."""
    indices = list(range(len(sequence)))
    tracked = track_all(sequence, indices, TrackingConfig())
    assert tracked.has_pose.all()
    poses = tracked.final_poses()
    truth = np.stack([sequence.true_pose(index) for index in indices])
    pairs: list[Pair] = []
    for i in range(0, len(indices) - gap, step):
        image, moved = (rectify(sequence.frame(j), sequence.calibration) for j in (i, i + gap))
        earlier, later = _surface(image), _surface(moved)
        true, ours = (inverse(p[i]) @ p[i + gap] for p in (truth, poses))
        pair = register_pair(earlier, later, true, ours)
        if pair.overlap >= _MIN_OVERLAP:
            grey = grey_residual(image, moved, true), grey_residual(image, moved, ours)
            pairs.append(replace(pair, grey=grey))
    return pairs


def _surface(image: RgbdImage) -> PointCloud:
    return surface_from_depth(image.depth_m, image.intrinsics, _SURFACE)


def grey_residual(earlier: RgbdImage, later: RgbdImage, T: NDArray[np.float64]) -> float:
    """Root mean square between the images, of the surface that both show under a motion.

    Args:
        T: T_earlier_later, [4, 4].
    """
    camera, depth_m = later.intrinsics, later.depth_m
    v, u = np.indices(depth_m.shape)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], 2)
    x, y, z = np.moveaxis(rays * depth_m[..., None] @ T[:3, :3].T + T[:3, 3], -1, 0)
    z = np.maximum(z, 1e-3)
    map_u = (x / z * camera.fx + camera.cx).astype(np.float32)
    map_v = (y / z * camera.fy + camera.cy).astype(np.float32)
    there_m = cv2.remap(earlier.depth_m, map_u, map_v, cv2.INTER_NEAREST)
    is_same = (depth_m > 0) & (there_m > 0)
    is_same &= np.abs(there_m - z) < _SAME_SURFACE * z + 0.02
    grey_there = cv2.remap(_grey(earlier), map_u, map_v, cv2.INTER_LINEAR)[is_same]
    grey_here = _grey(later)[is_same]
    gain, bias = np.polyfit(grey_there, grey_here, 1)  # exposure is not the motion's
    return float(np.sqrt(np.mean((gain * grey_there + bias - grey_here) ** 2)))


def _grey(image: RgbdImage) -> NDArray[np.float32]:
    return cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)


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
    true_grey, our_grey = np.median([p.grey for p in pairs], axis=0)
    print(f"  grey levels: truth {true_grey:.1f}, tracker {our_grey:.1f}")


def main(argv: list[str]) -> int:
    """Print the differences for the sequences named in argv."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", nargs="+", type=Path)
    parser.add_argument("--gap", type=int, default=30, help="frames between the two of a pair")
    parser.add_argument("--step", type=int, default=1, help="frames between pairs")
    arguments = parser.parse_args(argv)
    cv2.setNumThreads(1)
    for path in arguments.sequences:
        _print(path.name, measure(TrueSequence(path), arguments.gap, arguments.step))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
