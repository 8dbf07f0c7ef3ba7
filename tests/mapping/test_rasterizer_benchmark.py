"""`pointslam bench rasterizer` in its quick form."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
STAGES = {"project", "scatter", "blend_tiles", "blend_tiles_backward", "project_backward"}
ITERATION = {"decode", "rasterize", "loss", "backward", "update"}


@pytest.mark.system
def test_rows_and_machine_are_complete():
    command = [sys.executable, "-m", "benchmarks.rasterizer", "--quick", "--json"]

    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)

    table = json.loads(done.stdout)
    for threads, row in zip((1, 2), table["rows"], strict=True):
        assert (row["backend"], row["gaussians"], row["threads"]) == ("cpu", 5000, threads)
        assert (row["width"], row["height"]) == (320, 240)
        assert 0 < row["forward_ms"] < row["forward_backward_ms"]
        assert row["iteration_ms"] > 0
        assert set(row["stages_ms"]) == STAGES | ITERATION
    assert table["machine"]["fma_peak_gflops_per_core"] > 1
    assert table["machine"]["plain_kernel_to_ours"] > 1
