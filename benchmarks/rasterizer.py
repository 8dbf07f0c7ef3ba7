"""Times the rasterizer: a rendering, with gradients, and a whole iteration, by stages.

python -m benchmarks.rasterizer [--json] [--quick] [--device cuda] ...

The scene is a box of walls seen from inside, covered by flat Gaussians about as wide as their
spacing, which is what a map of a room looks like to a camera in it. An iteration is the mapper's:
decode the anchors in sight, 10 Gaussians each, render, compare by L1, SSIM and depth,
differentiate, and take a step of Adam on anchors and networks.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import numpy as np
import torch

from benchmarks.mapping_iteration import CHILDREN, ITERATION_STAGES, MappingIteration
from benchmarks.plain_rasterizer import PlainScene, milliseconds, peak_gflops, torch_ssim
from services.mapping.losses.ssim import SsimTarget, ssim
from services.mapping.rasterizer import (
    CpuRasterizer,
    Gaussians,
    GsplatRasterizer,
    Rasterizer,
    View,
    warm_up,
)
from services.mapping.rasterizer.cpu import Engine
from services.mapping.rasterizer.scratch import Scratch
from services.mapping.rasterizer.simd import LANES
from services.mapping.rasterizer.threads import Workers
from services.mapping.rasterizer.tiles_forward import Images
from shared.camera import Intrinsics

ROOM_M = np.array([4.0, 2.5, 4.0])
SIZES = ((320, 240), (640, 480), (1200, 680))
QUICK_SIZES = ((320, 240),)
# Operations per blended (Gaussian, pixel) pair, the least that the method needs.
FORWARD_FLOPS, BACKWARD_FLOPS = 27, 47


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
    iteration_ms: float
    stages_ms: dict[str, float]


class TimedWorkers(Workers):
    """Workers that note how long each kernel took."""

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        self.times: dict[str, list[float]] = {}

    def run(self, kernel: Callable, *arguments: object) -> None:
        """Run a kernel on all threads and note its wall time."""
        start = time.perf_counter()
        super().run(kernel, *arguments)
        elapsed = time.perf_counter() - start
        self.times.setdefault(kernel.__name__.strip("_"), []).append(elapsed)

    def stages_ms(self) -> dict[str, float]:
        """Median milliseconds of each kernel."""
        return {name: _median_ms(times) for name, times in self.times.items()}


def main(argv: list[str]) -> int:
    """Print the table, or with --json rows and machine as JSON."""
    options = _options(argv)
    rows = []
    for row in _measure(options):
        rows.append(row)
        if not options.json:
            print(_line(row), flush=True)
    machine = _machine() if options.device == "cpu" else {"device": torch.cuda.get_device_name()}
    if options.json:
        print(json.dumps({"rows": [asdict(row) for row in rows], "machine": machine}))
    else:
        print("\n".join(f"{name}: {value}" for name, value in machine.items()))
    return 0


def _line(row: Row) -> str:
    kernels = {name: ms for name, ms in row.stages_ms.items() if name not in ITERATION_STAGES}
    total = sum(kernels.values())
    stages = ", ".join(f"{name} {100.0 * ms / total:.0f} %" for name, ms in kernels.items())
    return (
        f"{row.backend} {row.gaussians:7d} Gaussians {row.width:4d}x{row.height:<3d} "
        f"{row.threads} threads: forward {row.forward_ms:6.1f} ms, with backward "
        f"{row.forward_backward_ms:6.1f} ms, iteration {row.iteration_ms:6.1f} ms ({stages})"
    )


def _options(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="rasterizer", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print rows as JSON")
    parser.add_argument("--quick", action="store_true", help="one small row per number of threads")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--gaussians", type=int, nargs="+", default=[20_000, 100_000, 200_000], metavar="N"
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], metavar="N")
    parser.add_argument("--repeats", type=int, default=9, help="renderings per median")
    options = parser.parse_args(argv)
    if options.quick:
        options.gaussians, options.repeats = [5_000], 3
    return options


def _measure(options: argparse.Namespace) -> Iterator[Row]:
    torch.set_num_threads(1)
    if options.device == "cpu":
        warm_up()
    for count in options.gaussians:
        gaussians = room(count, options.device)
        for width, height in QUICK_SIZES if options.quick else SIZES:
            for threads, rasterizer, pool in _backends(options):
                with _cores(threads):
                    case = _Case(rasterizer, gaussians, _view(width, height))
                    times, stages = case.time(options.repeats, pool)
                yield Row(options.device, count, width, height, threads, *times, stages)


@contextmanager
def _cores(count: int) -> Iterator[None]:
    """Let everything use so many cores; all for 0. The mapper takes one thread per core."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(allowed)[:count] or allowed)
    yield
    os.sched_setaffinity(0, allowed)


def _backends(options: argparse.Namespace) -> Iterator[tuple[int, Rasterizer, TimedWorkers | None]]:
    if options.device == "cuda":
        yield 0, GsplatRasterizer(), None
        return
    for threads in options.threads:
        pool = TimedWorkers(threads)
        yield threads, CpuRasterizer(pool=pool), pool


def _machine() -> dict[str, float | str]:
    """The processor, and ratios of yardsticks to our kernels, all on one thread."""
    view, gaussians, pool = _view(640, 480), room(100_000), TimedWorkers(1)
    engine = Engine(pool, Scratch())
    frame = engine.prepare(gaussians, view)
    for _ in range(9):
        images = Images(*(image.numpy().reshape(-1) for image in engine.blend(frame)))
        pairs = engine.gather(frame, images, images)
        engine.differentiate(frame.splats, frame.camera, pairs)
    ours = pool.stages_ms()
    plain = PlainScene.of(frame.projected, frame.camera)
    plain_ms, pairs, peak = milliseconds(plain.blend, 3), plain.blend(), peak_gflops()
    pair_ms = 1e-6 * pairs / peak
    backward_to_floor = ours["blend_tiles_backward"] / (pair_ms * BACKWARD_FLOPS)
    return {
        "processor": platform.processor() or platform.machine(),
        "lanes": LANES,
        "fma_peak_gflops_per_core": round(peak, 1),
        "pairs_per_pixel": round(pairs / (640 * 480), 1),
        "forward_blending_to_floor": round(ours["blend_tiles"] / (pair_ms * FORWARD_FLOPS), 1),
        "backward_blending_to_floor": round(backward_to_floor, 1),
        "plain_kernel_to_ours": round(plain_ms / ours["blend_tiles"], 1),
        "torch_ssim_to_ours": round(_ssim_ratio(), 1),
    }


def _ssim_ratio() -> float:
    """Time of torch's SSIM with gradient over ours, 640x480, one thread."""
    generator = torch.Generator().manual_seed(0)
    image, target = (torch.rand(480, 640, 3, generator=generator) for _ in range(2))
    image.requires_grad_()
    prepared = SsimTarget.of(target, 1)
    ours = milliseconds(lambda: ssim(image, prepared, 1).backward(), 9)
    return milliseconds(lambda: torch_ssim(image, target).backward(), 3) / ours


def room(count: int, device: str = "cpu") -> Gaussians:
    """Flat Gaussians on the walls of a room; they require gradients.

    Anchors lie in random order, the children of each side by side in memory and in space.
    """
    rng = np.random.default_rng(0)
    anchors = -(-count // CHILDREN)
    normals = rng.integers(0, 3, anchors)
    centres = rng.uniform(-0.5, 0.5, (anchors, 3))
    centres[np.arange(anchors), normals] = rng.choice([-0.5, 0.5], anchors)
    spread = 0.5 / math.sqrt(anchors)
    means = np.repeat(centres, CHILDREN, axis=0)[:count] + rng.normal(0.0, spread, (count, 3))
    normals = np.repeat(normals, CHILDREN)[:count]
    means[np.arange(count), normals] = np.round(means[np.arange(count), normals] + 0.5) - 0.5
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


@dataclass(frozen=True)
class _Case:
    """One line's work."""

    rasterizer: Rasterizer
    gaussians: Gaussians
    view: View

    def time(
        self, repeats: int, pool: TimedWorkers | None
    ) -> tuple[tuple[float, float, float], dict[str, float]]:
        """Median ms of forward, forward and backward together, and an iteration; and stages."""
        both = [self._render() for _ in range(repeats + 2)][2:]  # two touch fresh memory
        kernels = pool.stages_ms() if pool else {}
        step, iterations = MappingIteration(self.rasterizer, self.gaussians, self.view), []
        for _ in range(repeats + 2):
            start = time.perf_counter()
            step.run()
            _synchronise(self.gaussians.means)
            iterations.append(time.perf_counter() - start)
        stages = {name: _median_ms(times) for name, times in step.stages.times.items()}
        forward, whole = (_median_ms([times[i] for times in both]) for i in range(2))
        return (forward, whole, _median_ms(iterations[2:])), {**kernels, **stages}

    def _render(self) -> tuple[float, float]:
        """Seconds of a rendering, and with its gradients."""
        start = time.perf_counter()
        rendered = self.rasterizer(self.gaussians, self.view)
        _synchronise(rendered.colour)
        forward = time.perf_counter() - start
        images = rendered.colour, rendered.depth, rendered.alpha
        slopes = [torch.ones_like(image) for image in images]
        torch.autograd.grad(images, self.gaussians.tensors(), slopes)
        _synchronise(rendered.colour)
        return forward, time.perf_counter() - start


def _median_ms(seconds: list[float]) -> float:
    return round(1e3 * statistics.median(seconds), 2)


def _synchronise(image: torch.Tensor) -> None:
    if image.is_cuda:
        torch.cuda.synchronize()


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))
