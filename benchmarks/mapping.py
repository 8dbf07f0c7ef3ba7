"""Mapping alone, with the true poses of a sequence: quality against time, and the ablations.

pointslam bench mapping [SEQUENCE] [--frames N] [--refine N] [--variants NAME ...] [--json]

Each variant is one map, in a process of its own; `full` is the default settings and the others
leave one part of the paper out (Table 5) or in. Without a sequence, a procedural room is recorded
first. Growing begins at densification.first_iteration: shorter runs do not show it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.mapping_run import RunPlan, measure
from pointslam.synth import SynthOptions, write_sequence
from shared.errors import PointSlamError

ABLATIONS = {
    "full": (),
    "plain": ("anchors.gaussians=plain",),
    "no-compensation": (
        "anchors.features=random",
        "rates.exposure_gain=0",
        "rates.exposure_bias=0",
    ),
    "no-growing": ("densification.grow_share=0",),
    "no-depth-loss": ("loss.depth=0",),
    "overlapping": ("schedule.draws=overlapping",),
}
READINGS = {  # of the paper's words, beside the defaults
    "environment": ("anchors.features=environment",),
    "colours+environment": ("anchors.features=both",),
    "halving": ("densification.rule=halving",),
}
VARIANTS = ABLATIONS | READINGS
_SYNTH_FRAMES = 60


def arguments(argv: list[str]) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(prog="pointslam bench mapping", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("sequence", type=Path, nargs="?")
    parser.add_argument("--frames", type=int, default=120, help="the first N only; 0 for all")
    parser.add_argument("--every", type=int, default=5, help="frames between keyframes")
    parser.add_argument("--holdout", type=int, default=8)
    parser.add_argument("--iterations", type=int, help="a frame")
    parser.add_argument("--refine", type=int, default=100, help="iterations after the last frame")
    parser.add_argument("--scores", type=int, default=1, help="parts of the refinement to score")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(ABLATIONS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(argv)


def plan_of(options: argparse.Namespace) -> RunPlan:
    """The full variant as the command line wants it."""
    names = ("sequence", "frames", "every", "holdout", "iterations", "refine", "scores", "seed")
    return RunPlan(**{n: getattr(options, n) for n in names}, settings=tuple(options.set))


def measure_variants(plan: RunPlan, names: list[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """One map after the other, each in a fresh process, so that its memory is its own."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, max_tasks_per_child=1) as pool:
        for name in names:
            settings = (*VARIANTS[name], *plan.settings)
            yield name, pool.submit(measure, replace(plan, settings=settings)).result()


def lines(name: str, result: dict[str, Any]) -> Iterator[str]:
    """One variant for people: its costs, then a line for each score."""
    size = result["map"]
    yield (
        f"{name}: {result['keyframes']} keyframes, {size['anchors']} anchors "
        f"({size['primary']} primary), map {size['num_bytes'] / 1e6:.1f} MB, "
        f"insertion {result['insert_keyframe_ms']:.0f} ms, "
        f"iteration {result['iteration_ms']:.0f} ms, peak {result['peak_rss_mb']} MB"
    )
    for point in result["curve"]:
        blocks = (f"{_score(point[block])}" for block in ("all", "heldout", "novel"))
        when = f"{point['phase']:8} {point['iterations']:6} it {point['seconds']:7.1f} s"
        yield f"  {when}  " + "   ".join(blocks)


def _score(block: dict[str, float | None]) -> str:
    """PSNR / SSIM / depth L1."""
    if block["psnr_db"] is None:
        return f"{'-':>21}"
    depth = "-" if block["depth_l1_m"] is None else f"{100 * block['depth_l1_m']:.2f}"
    return f"{block['psnr_db']:5.2f} / {block['ssim']:.3f} / {depth:>5}"


def ablation(results: dict[str, dict[str, Any]]) -> Iterator[str]:
    """What each variant gains over the full map on held-out frames."""
    ends = {name: result["curve"][-1]["heldout"] for name, result in results.items()}
    if "full" not in ends or ends["full"]["psnr_db"] is None:
        return
    yield "held-out against full, after the last iteration:"
    for name, end in ends.items():
        gains = end["psnr_db"] - ends["full"]["psnr_db"], end["ssim"] - ends["full"]["ssim"]
        yield f"  {name:20} {gains[0]:+6.2f} dB  SSIM {gains[1]:+.3f}"


def run(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Measure all variants; prints each as it ends, unless the result is to be JSON."""
    results = {}
    if not options.json:
        print("PSNR dB / SSIM / depth L1 cm of all, held-out and novel views")
    for name, result in measure_variants(plan_of(options), options.variants):
        results[name] = result
        if not options.json:
            print("\n".join(lines(name, result)), flush=True)
    return results


def main(argv: list[str]) -> int:
    """Print the measurements."""
    options = arguments(argv)
    try:
        with tempfile.TemporaryDirectory() as folder:
            if options.sequence is None:
                options.sequence = Path(folder) / "room"
                write_sequence(options.sequence, SynthOptions(num_frames=_SYNTH_FRAMES))
            results = run(options)
    except PointSlamError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(json.dumps(results, indent=1) if options.json else "\n".join(ablation(results)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
