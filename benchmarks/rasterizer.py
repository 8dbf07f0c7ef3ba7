"""Times the rasterizer: milliseconds per rendering and per rendering with gradients.

The scene is a box of walls seen from inside, covered by flat Gaussians about as wide as their
spacing, which is what a map of a room looks like to a camera in it.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
import torch

from services.mapping.rasterizer import (
    CpuRasterizer,
    Gaussians,
    GsplatRasterizer,
    Rasterizer,
    View,
    warm_up,
)
from shared.camera import Intrinsics

ROOM_M = np.array([4.0, 2.5, 4.0])
SIZES = ((320, 240), (640, 480))


@dataclass(frozen=True)
class Row:
    """One line of the table; times are medians."""

    backend: str
    gaussians: int
    width: int
    height: int
    threads: int
    forward_ms: float
    forward_backward_ms: float


def main(argv: list[str]) -> int:
    """Print the table, or with --json its rows as JSON."""
    options = _options(argv)
    rows = _measure(options)
    if options.json:
        print(json.dumps([asdict(row) for row in rows]))
        return 0
    print(f"{'backend':8}{'Gaussians':>10}{'image':>10}{'threads':>9}", end="")
    print(f"{'forward ms':>12}{'+ backward':>12}")
    for row in rows:
        image = f"{row.width}x{row.height}"
        print(
            f"{row.backend:8}{row.gaussians:10d}{image:>10}{row.threads:9d}"
            f"{row.forward_ms:12.1f}{row.forward_backward_ms:12.1f}",
            flush=True,
        )
    return 0


def _options(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="rasterizer", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print rows as JSON")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--gaussians", type=int, nargs="+", default=[20_000, 100_000, 200_000], metavar="N"
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], metavar="N")
    parser.add_argument("--repeats", type=int, default=9, help="renderings per median")
    return parser.parse_args(argv)


def _measure(options: argparse.Namespace) -> Iterator[Row]:
    torch.set_num_threads(1)
    if options.device == "cpu":
        warm_up()
    for count in options.gaussians:
        gaussians = room(count, options.device)
        for width, height in SIZES:
            for threads, rasterizer in _backends(options):
                times = _time(rasterizer, gaussians, _view(width, height), options.repeats)
                yield Row(options.device, count, width, height, threads, *times)


def _backends(options: argparse.Namespace) -> Iterator[tuple[int, Rasterizer]]:
    if options.device == "cuda":
        yield 0, GsplatRasterizer()
        return
    for threads in options.threads:
        yield threads, CpuRasterizer(threads)


def room(count: int, device: str = "cpu") -> Gaussians:
    """Flat Gaussians on the walls of a room, in random order; they require gradients."""
    rng = np.random.default_rng(0)
    normals = rng.integers(0, 3, count)
    means = rng.uniform(-0.5, 0.5, (count, 3))
    means[np.arange(count), normals] = rng.choice([-0.5, 0.5], count)
    area = 2.0 * (ROOM_M.prod() / ROOM_M).sum()
    scales = 0.6 * np.sqrt(area / count) * np.exp(rng.normal(0.0, 0.25, (count, 3)))
    scales[np.arange(count), normals] *= 0.3
    quats = np.concatenate([np.ones((count, 1)), rng.normal(0.0, 0.1, (count, 3))], axis=1)
    fields = (means * ROOM_M, scales, quats, rng.uniform(0.6, 0.9, count), rng.random((count, 3)))
    return Gaussians(
        *(torch.tensor(f, dtype=torch.float32, device=device, requires_grad=True) for f in fields)
    )


def _view(width: int, height: int) -> View:
    focal = 525.0 * width / 640.0
    T_camera_world = np.eye(4)
    T_camera_world[:3, 3] = 0.0, 0.0, 0.45 * ROOM_M[2]  # the camera stands at the back wall
    centre = (width - 1) / 2.0, (height - 1) / 2.0
    return View(T_camera_world, Intrinsics(focal, focal, *centre, width, height))


def _time(
    rasterizer: Rasterizer, gaussians: Gaussians, view: View, repeats: int
) -> tuple[float, float]:
    """Median milliseconds of forward, and of forward and backward together."""
    forward, both = [], []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        rendered = rasterizer(gaussians, view)
        _synchronise(rendered.colour)
        forward.append(time.perf_counter() - start)
        (rendered.colour.sum() + rendered.depth.sum() + rendered.alpha.sum()).backward()
        _synchronise(rendered.colour)
        both.append(time.perf_counter() - start)
    # The first two touch fresh memory.
    return tuple(round(1e3 * statistics.median(times[2:]), 2) for times in (forward, both))


def _synchronise(image: torch.Tensor) -> None:
    if image.is_cuda:
        torch.cuda.synchronize()


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))
