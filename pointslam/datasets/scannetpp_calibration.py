"""What ScanNet++'s iPhone and DSLR recordings have in common."""

from __future__ import annotations

from pathlib import Path

from pointslam.datasets.base import SequenceOptions, depth_intrinsics
from shared.camera import Calibration, Camera

DEPTH_SCALE = 1000.0


def calibration(
    camera: Camera, depth_size: tuple[int, int], options: SequenceOptions
) -> Calibration:
    """Depth in millimetres in the colour camera, at a resolution (width, height) of its own."""
    other = depth_intrinsics(camera.intrinsics, depth_size)
    depth = None if other is None else Camera(other, camera.distortion, camera.fisheye)
    return Calibration(camera, float(options.depth_scale or DEPTH_SCALE), depth)


def scene_name(path: Path) -> str:
    """`SCENE-iphone` or `SCENE-dslr`."""
    resolved = path.resolve()
    return f"{resolved.parent.name}-{resolved.name}"
