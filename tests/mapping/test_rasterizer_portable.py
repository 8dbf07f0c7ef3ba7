"""The kernels on a processor without wide vectors, and from a warm cache."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from services.mapping.rasterizer import CpuRasterizer, Gaussians, View, warm_up
from shared import se3
from shared.camera import Intrinsics

ROOT = Path(__file__).resolve().parents[2]
CAMERA = Intrinsics(fx=70.0, fy=70.0, cx=33.0, cy=20.0, width=70, height=45)
POSE = se3.exp([0.05, -0.03, 0.02, 0.01, 0.05, -0.02])

# Renders a saved scene and saves images and gradients.
SCRIPT = """
import sys
import torch
from services.mapping.rasterizer import CpuRasterizer, Gaussians, View
from services.mapping.rasterizer.simd import LANES
from shared.camera import Intrinsics

fields, pose = torch.load(sys.argv[1])
leaves = [field.requires_grad_() for field in fields]
camera = Intrinsics(70.0, 70.0, 33.0, 20.0, 70, 45)
rendered = CpuRasterizer(2)(Gaussians(*leaves), View(pose, camera))
(rendered.colour.square().sum() + rendered.depth.sum()).backward()
images = [rendered.colour.detach(), rendered.depth.detach(), rendered.alpha.detach()]
torch.save((LANES, images, [leaf.grad for leaf in leaves]), sys.argv[2])
"""

# Ends with an error that names what it had to compile.
START = """
import sys
from numba.core import event
from services.mapping.rasterizer import warm_up

with event.install_recorder("numba:compile") as compiled:
    warm_up()
sys.exit(", ".join(str(what.data["dispatcher"]) for _, what in compiled.buffer) or 0)
"""


def fields(count):
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(count, 3, generator=generator) - torch.tensor([0.5, 0.5, -1.0])
    return [
        means,
        0.005 + 0.05 * torch.rand(count, 3, generator=generator),
        torch.randn(count, 4, generator=generator),
        0.1 + 0.8 * torch.rand(count, generator=generator),
        torch.rand(count, 3, generator=generator),
    ]


def run(arguments, **environment):
    command = [sys.executable, "-c", *map(str, arguments)]
    subprocess.run(command, check=True, cwd=ROOT, env={**os.environ, **environment})


@pytest.mark.system
def test_a_processor_without_wide_vectors_renders_the_same(tmp_path):
    scene = fields(400)
    torch.save((scene, torch.from_numpy(POSE)), tmp_path / "scene")

    run(
        [SCRIPT, tmp_path / "scene", tmp_path / "outcome"],
        NUMBA_CPU_NAME="generic",
        NUMBA_CPU_FEATURES="",
        NUMBA_CACHE_DIR=str(tmp_path),
    )

    lanes, images, gradients = torch.load(tmp_path / "outcome")
    leaves = [field.clone().requires_grad_() for field in scene]
    rendered = CpuRasterizer(2)(Gaussians(*leaves), View(POSE, CAMERA))
    (rendered.colour.square().sum() + rendered.depth.sum()).backward()
    here = [rendered.colour, rendered.depth, rendered.alpha, *(leaf.grad for leaf in leaves)]
    assert lanes == 8
    for found, expected in zip([*images, *gradients], here, strict=True):
        assert (found - expected.detach()).norm() < 1e-4 * expected.detach().norm()


@pytest.mark.system
def test_from_a_warm_cache_no_kernel_is_compiled_again():
    warm_up()

    run([START])
