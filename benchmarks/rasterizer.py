"""Times the rasterizer: a rendering, with gradients, and a whole iteration, by stages.

The scene is a box of walls seen from inside, covered by flat Gaussians about as wide as their
spacing, which is what a map of a room looks like to a camera in it. An iteration renders,
compares by L1, SSIM and depth, differentiates, and takes a step of Adam on all Gaussians.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import numpy as np
import torch

from benchmarks.plain_rasterizer import blend_pixels, milliseconds, peak_gflops, torch_ssim
from services.mapping.rasterizer import (
    CpuRasterizer,
    Gaussians,
    GsplatRasterizer,
    Rasterizer,
    Rendered,
    View,
    warm_up,
)
from services.mapping.rasterizer.cpu import Engine
from services.mapping.rasterizer.scratch import Scratch
from services.mapping.rasterizer.simd import LANES
from services.mapping.rasterizer.threads import Workers
from services.mapping.ssim import SsimTarget, ssim
from shared.camera import Intrinsics

ROOM_M = np.array([4.0, 2.5, 4.0])
SIZES = ((320, 240), (640, 480), (1200, 680))
# Operations per blended (Gaussian, pixel) pair, the least that the method needs.
FORWARD_FLOPS = 27


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
    stages = ", ".join(f"{name} {value}" for name, value in row.stages_ms.items())
    return (
        f"{row.backend} {row.gaussians:7d} Gaussians {row.width:4d}x{row.height:<3d} "
        f"{row.threads} threads: forward {row.forward_ms:6.1f} ms, with backward "
        f"{row.forward_backward_ms:6.1f} ms, iteration {row.iteration_ms:6.1f} ms ({stages})"
    )


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
            for threads, rasterizer, pool in _backends(options):
                times = _time(rasterizer, gaussians, _view(width, height), options.repeats)
                stages = pool.stages_ms() if pool else {}
                yield Row(options.device, count, width, height, threads, *times, stages)


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
    engine, pixels = Engine(pool, Scratch()), 640 * 480
    frame = engine.prepare(gaussians, view)
    assert frame.lists is not None
    tiles = frame.tiles(frame.lists)
    for _ in range(9):
        engine.blend(frame)
    ours_ms, plain_ms = (
        pool.stages_ms()["blend_tiles"],
        milliseconds(lambda: blend_pixels(tiles), 3),
    )
    pairs, peak = blend_pixels(tiles), peak_gflops()
    floor_ms = 1e-6 * pairs * FORWARD_FLOPS / peak
    return {
        "processor": platform.processor() or platform.machine(),
        "lanes": LANES,
        "fma_peak_gflops_per_core": round(peak, 1),
        "pairs_per_pixel": round(pairs / pixels, 1),
        "forward_blending_to_floor": round(ours_ms / floor_ms, 1),
        "plain_kernel_to_ours": round(plain_ms / ours_ms, 1),
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
) -> tuple[float, float, float]:
    """Median milliseconds of forward, forward and backward together, and an iteration."""
    forward, both, iteration = [], [], []
    step = _Iteration(rasterizer, gaussians, view)
    for _ in range(repeats + 2):
        start = time.perf_counter()
        rendered = rasterizer(gaussians, view)
        _synchronise(rendered.colour)
        forward.append(time.perf_counter() - start)
        (rendered.colour.sum() + rendered.depth.sum() + rendered.alpha.sum()).backward()
        _synchronise(rendered.colour)
        both.append(time.perf_counter() - start)
        start = time.perf_counter()
        step.run()
        _synchronise(rendered.colour)
        iteration.append(time.perf_counter() - start)
    # The first two touch fresh memory.
    return _median_ms(forward[2:]), _median_ms(both[2:]), _median_ms(iteration[2:])


class _Iteration:
    """One step towards an image that is a little darker than the present one."""

    def __init__(self, rasterizer: Rasterizer, gaussians: Gaussians, view: View) -> None:
        self._render: Callable[[], Rendered] = lambda: rasterizer(gaussians, view)
        self._optimizer = torch.optim.Adam(gaussians.tensors(), lr=1e-7, fused=True)
        with torch.no_grad():
            rendered = self._render()
        self._colour, self._depth = 0.9 * rendered.colour, rendered.depth
        self._target = None if self._colour.is_cuda else SsimTarget.of(self._colour)

    def run(self) -> None:
        """Render, compare, differentiate, step."""
        self._optimizer.zero_grad(set_to_none=True)
        rendered = self._render()
        loss = 0.8 * (rendered.colour - self._colour).abs().mean()
        loss = loss + 0.5 * (rendered.depth - self._depth).abs().mean()
        if self._target is not None:
            loss = loss - 0.2 * ssim(rendered.colour, self._target)
        loss.backward()
        self._optimizer.step()


def _median_ms(seconds: list[float]) -> float:
    return round(1e3 * statistics.median(seconds), 2)


def _synchronise(image: torch.Tensor) -> None:
    if image.is_cuda:
        torch.cuda.synchronize()


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))
