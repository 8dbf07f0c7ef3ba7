"""Writes a procedural recording as one of our own folders."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pointslam.synth.kinect import KinectNoise, measure_colour, measure_depth
from pointslam.synth.lighting import bake_light
from pointslam.synth.path import camera_path, views_off_path
from pointslam.synth.render import render_colour, render_depth
from pointslam.synth.room import build_room
from pointslam.synth.scene import Scene, pack_scene
from shared.camera import Intrinsics
from shared.errors import ConfigError
from shared.images import encode_jpeg, encode_png
from shared.se3 import Matrix, Pose

RATE_HZ = 30
DEPTH_SCALE = 5000
_FIRST_VIEW_S = 1000
_JPEG_QUALITY = 92


class Noise(StrEnum):
    """What the sensor adds to the truth of frames; views off the path are always exact."""

    KINECT = "kinect"
    NONE = "none"


@dataclass(frozen=True)
class SynthOptions:
    """What to record."""

    num_frames: int = 120
    seed: int = 0
    noise: Noise = Noise.KINECT
    num_views: int = 10
    camera: Intrinsics = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)

    def __post_init__(self) -> None:
        if not 2 <= self.num_frames <= 100_000:
            raise ConfigError(f"frames must be 2 to 100000, got {self.num_frames}")
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed}")


def write_sequence(
    folder: Path, options: SynthOptions, progress: Callable[[int], None] = lambda done: None
) -> None:
    """Render the seed's room into `folder`; `progress` is called with the number of images done."""
    record_scene(folder, lit_room(options.seed), options, progress)


def lit_room(seed: int) -> Scene:
    """The room of a seed with its light, which takes seconds to bake."""
    return pack_scene(bake_light(build_room(seed), seed, os.cpu_count() or 1))


def record_scene(
    folder: Path,
    scene: Scene,
    options: SynthOptions,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Render a scene into `folder`: images, lists, truth, calibration and views off the path."""
    path = camera_path(options.num_frames)
    views = views_off_path(path, options.num_views, options.seed)
    exact = SynthOptions(camera=options.camera, seed=options.seed, noise=Noise.NONE)
    stamps = [f"{i / RATE_HZ:.6f}" for i in range(len(path))]
    view_stamps = [f"{_FIRST_VIEW_S + i}.000000" for i in range(len(views))]
    jobs = [(folder, s, T, options) for s, T in zip(stamps, path, strict=True)]
    jobs += [(folder / "novel", s, T, exact) for s, T in zip(view_stamps, views, strict=True)]
    for target in (folder, folder / "novel"):
        for kind in ("rgb", "depth"):
            (target / kind).mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        written = pool.map(lambda job: _write_frame(scene, *job), jobs)
        for done, _ in enumerate(written, 1):
            progress(done)
    _write_lists(folder, stamps, path)
    _write_trajectory(folder / "novel" / "groundtruth.txt", zip(view_stamps, views, strict=True))
    calibration = asdict(options.camera) | {"distortion": "none", "depth_scale": DEPTH_SCALE}
    (folder / "calibration.json").write_text(json.dumps(calibration, indent=2) + "\n")


def render_frame(
    scene: Scene, T_world_camera: Matrix, options: SynthOptions, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour [H, W, 3] and depth in metres [H, W] of one pose, with the sensor's noise."""
    colour = render_colour(scene, T_world_camera, options.camera)
    depth_m, cosine = render_depth(scene, T_world_camera, options.camera)
    if options.noise is Noise.NONE:
        return np.clip(np.round(colour), 0, 255).astype(np.uint8), depth_m
    noise = KinectNoise()
    measured = measure_depth(depth_m, cosine, options.camera, noise, rng)
    return measure_colour(colour, noise, rng), measured


def _write_frame(
    scene: Scene, folder: Path, stamp: str, T_world_camera: Matrix, options: SynthOptions
) -> None:
    rng = np.random.default_rng([options.seed, round(1e6 * float(stamp))])
    rgb, depth_m = render_frame(scene, T_world_camera, options, rng)
    raw = np.round(depth_m * DEPTH_SCALE).astype(np.uint16)
    (folder / "rgb" / f"{stamp}.jpg").write_bytes(encode_jpeg(rgb, _JPEG_QUALITY).bytes)
    (folder / "depth" / f"{stamp}.png").write_bytes(encode_png(raw))


def _write_lists(folder: Path, stamps: list[str], path: list[Matrix]) -> None:
    colour = [f"{s} rgb/{s}.jpg" for s in stamps]
    depth = [f"{s} depth/{s}.png" for s in stamps]
    both = [f"{c} {d}" for c, d in zip(colour, depth, strict=True)]
    header = "# timestamp filename\n"
    for name, lines in (("rgb", colour), ("depth", depth)):
        (folder / f"{name}.txt").write_text(header + "\n".join(lines) + "\n")
    (folder / "associations.txt").write_text("\n".join(both) + "\n")
    _write_trajectory(folder / "groundtruth.txt", zip(stamps, path, strict=True))


def _write_trajectory(file: Path, poses: Iterable[tuple[str, Matrix]]) -> None:
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    for stamp, T in poses:
        p, q = Pose.from_matrix(T).position, Pose.from_matrix(T).orientation
        numbers = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        rows.append(" ".join([stamp, *(f"{n:.7f}" for n in numbers)]))
    file.write_text("\n".join(rows) + "\n")
