"""Mapping alone, with the true poses of a sequence: quality on held-out frames, and time.

python -m benchmarks.mapping [SEQUENCE] [--frames N] [--refine N] [--json]

Without a sequence, a procedural room is recorded into a temporary folder first.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pointslam.datasets import FileSequence, is_held_out, open_sequence
from pointslam.synth import SynthOptions, write_sequence
from services.mapping.config import MappingConfig
from services.mapping.pipeline import MapFigures, Mapper, NewKeyframe
from services.mapping.ssim import ssim
from services.mapping.warm_up import warm_up
from shared.config import override, read_overrides
from shared.errors import PointSlamError
from shared.frames import Frame
from shared.maps import RenderRequest
from shared.rectify import RgbdImage, rectify
from shared.tracks import KeyframePoses


@dataclass(frozen=True)
class Score:
    """Means over views, no mask."""

    psnr_db: float
    ssim: float
    depth_l1_m: float
    views: int


def arguments(argv: list[str]) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", type=Path, nargs="?")
    parser.add_argument("--frames", type=int, default=None, help="the first N only")
    parser.add_argument("--every", type=int, default=5, help="frames between keyframes")
    parser.add_argument("--holdout", type=int, default=8)
    parser.add_argument("--refine", type=int, default=200, help="iterations after the last frame")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(argv)


def frame_of(sequence: FileSequence, index: int) -> Frame:
    """A frame as the services pass it on."""
    recorded = sequence.frame(index)
    return Frame(seq=index, t_ns=recorded.t_ns, rgb=recorded.rgb, depth=recorded.depth)


def true_pose(sequence: FileSequence, index: int) -> NDArray[np.float64]:
    """`T_world_camera` [4, 4] of a frame."""
    pose = sequence.truth(index)
    if pose is None:
        raise PointSlamError(f"frame {index} of {sequence.name} has no true pose")
    return pose


def orb_points(image: RgbdImage, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """ORB keypoints with depth, in the world, [L, 3]: what tracking would call landmarks."""
    grey = cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY)
    keypoints = cv2.ORB_create(1000).detect(grey, None)  # pyright: ignore
    uv = np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2)
    z = image.depth_m[uv[:, 1].astype(int), uv[:, 0].astype(int)].astype(np.float64)
    uv, z, k = uv[z > 0], z[z > 0], image.intrinsics
    points = np.stack([(uv[:, 0] - k.cx) / k.fx * z, (uv[:, 1] - k.cy) / k.fy * z, z], axis=1)
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def run_online(mapper: Mapper, sequence: FileSequence, options: argparse.Namespace) -> float:
    """Feed the sequence as the mapping service would be fed; returns the mapper's seconds."""
    count = min(len(sequence), options.frames or len(sequence))
    iterations = mapper.config.schedule.iterations_per_frame
    keyframes: dict[int, NDArray[np.float64]] = {}
    seconds, newest = 0.0, -options.every
    for index in range(count):
        start = time.perf_counter()
        if index - newest >= options.every and not is_held_out(index, options.holdout):
            newest, keyframes[index] = index, true_pose(sequence, index)
            mapper.insert_keyframe(new_keyframe(sequence, index, keyframes))
        mapper.iterate(iterations)
        seconds += time.perf_counter() - start
    return seconds


def new_keyframe(
    sequence: FileSequence, index: int, keyframes: dict[int, NDArray[np.float64]]
) -> NewKeyframe:
    """The keyframe with the poses of all before it."""
    frame = frame_of(sequence, index)
    image = rectify(frame, sequence.calibration)
    seqs, poses = np.array(list(keyframes), np.int64), np.stack(list(keyframes.values()))
    landmarks = orb_points(image, keyframes[index])
    return NewKeyframe(frame, KeyframePoses(len(seqs), seqs, poses), landmarks)


def run_refinement(mapper: Mapper, iterations: int) -> float:
    """Refine; returns seconds."""
    start = time.perf_counter()
    for done in range(iterations):
        mapper.refine(done / iterations)
    return time.perf_counter() - start


def held_out_score(mapper: Mapper, sequence: FileSequence, options: argparse.Namespace) -> Score:
    """Render the held-out frames from their true poses."""
    count = min(len(sequence), options.frames or len(sequence))
    rows = []
    for index in (i for i in range(count) if is_held_out(i, options.holdout)):
        frame = frame_of(sequence, index)
        image = rectify(frame, sequence.calibration)
        request = RenderRequest(true_pose(sequence, index), image.intrinsics, frame.t_ns)
        reply = mapper.render(request)
        known = image.depth_m > 0
        rows.append(
            (
                -10.0 * np.log10(np.mean((floats(reply.rgb) - floats(image.rgb)).numpy() ** 2)),
                float(ssim(floats(reply.rgb), floats(image.rgb))),
                float(np.abs(reply.depth_m - image.depth_m)[known].mean()),
            )
        )
    return Score(*np.mean(rows, axis=0).tolist(), views=len(rows))


def floats(rgb: NDArray[np.uint8]) -> torch.Tensor:
    """Bytes as 0 to 1."""
    return torch.from_numpy(rgb.astype(np.float32) / np.float32(255.0))


def measure(sequence: FileSequence, options: argparse.Namespace) -> dict[str, Any]:
    """Run both phases and score each."""
    config = override(MappingConfig(), read_overrides(None, options.set))
    mapper = Mapper(sequence.calibration, config, options.seed, torch.device("cpu"))
    online_s = run_online(mapper, sequence, options)
    result: dict[str, Any] = {
        "sequence": sequence.name,
        "keyframes": len(mapper.views),
        "online_s": online_s,
        "online": vars(held_out_score(mapper, sequence, options)),
        "stages_ms": mapper.stages.medians(),
    }
    if options.refine:
        result["refinement_s"] = run_refinement(mapper, options.refine)
        result["refined"] = vars(held_out_score(mapper, sequence, options))
    result["map"] = vars(MapFigures.of(mapper))
    result["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    return result


def table(result: dict[str, Any]) -> str:
    """The measurements for people."""
    lines = [
        f"{result['sequence']}: {result['keyframes']} keyframes, {result['map']['anchors']} anchors"
    ]
    for phase, seconds in (("online", "online_s"), ("refined", "refinement_s")):
        if phase in result:
            score = result[phase]
            lines.append(
                f"{phase:10} {score['psnr_db']:6.2f} dB  SSIM {score['ssim']:.3f}  "
                f"depth {100 * score['depth_l1_m']:.2f} cm  {result[seconds]:7.1f} s  "
                f"({score['views']} held-out views)"
            )
    stages = "  ".join(f"{name} {ms:.1f}" for name, ms in result["stages_ms"].items())
    return "\n".join([*lines, f"median ms: {stages}", f"peak {result['peak_rss_mb']} MB"])


def main(argv: list[str]) -> int:
    """Print the measurements."""
    options = arguments(argv)
    try:
        warm_up()
        with tempfile.TemporaryDirectory() as folder:
            if options.sequence is None:
                options.sequence = Path(folder) / "room"
                write_sequence(options.sequence, SynthOptions(num_frames=80))
            result = measure(open_sequence(options.sequence), options)
    except PointSlamError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(json.dumps(result, indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
