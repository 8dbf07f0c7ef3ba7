"""Benchmarks live beside the packages in a checkout; this runs one of them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from shared.errors import ConfigError, PointSlamError

NAMES = ("rasterizer", "tracking", "mapping", "renders", "gateway", "console", "failover", "fuzz")
_FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


def run_benchmark(name: str, options: Sequence[str]) -> None:
    """Run `benchmarks/<name>.py OPTIONS` in a process of its own; it prints its table or JSON.

    Raises:
        ConfigError: this is an installed package without its benchmarks.
        PointSlamError: the benchmark failed.
    """
    script = _FOLDER / f"{name}.py"
    if not script.is_file():
        raise ConfigError(f"{script} is absent: benchmarks need a checkout of the repository")
    code = subprocess.run([sys.executable, str(script), *options], check=False).returncode
    if code != 0:
        raise PointSlamError(f"the {name} benchmark ended with code {code}")
