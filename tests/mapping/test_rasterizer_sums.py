"""What each Gaussian shows of a view: an image summed under its weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from services.mapping.rasterizer import CpuRasterizer, Gaussians, View, binning
from services.mapping.rasterizer.scene import sums_by_gradients
from shared.camera import Intrinsics

VIEW = View(np.eye(4), Intrinsics(fx=100.0, fy=100.0, cx=50.0, cy=40.0, width=101, height=77))


@pytest.fixture(scope="module")
def cloud() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    count = 6000
    return Gaussians(
        torch.rand(count, 3, generator=generator) - torch.tensor([0.5, 0.5, -1.0]),
        0.005 + 0.03 * torch.rand(count, 3, generator=generator),
        torch.randn(count, 4, generator=generator),
        0.1 + 0.8 * torch.rand(count, generator=generator),
        torch.rand(count, 3, generator=generator),
    )


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    return torch.randn(77, 101, 4, generator=torch.Generator().manual_seed(1))


def test_a_gaussians_weights_sum_to_what_it_adds_to_alpha(cloud):
    rendered, sums = CpuRasterizer().with_sums(cloud, VIEW)

    weights = sums(torch.ones(77, 101, 4))

    assert weights.sum(0).tolist() == pytest.approx([float(rendered.alpha.sum())] * 4, rel=1e-4)


@pytest.mark.parametrize("most_pairs", [binning.MOST_PAIRS, 1000])
def test_sums_are_the_derivatives_by_the_colours(cloud, image, monkeypatch, most_pairs):
    expected = sums_by_gradients(CpuRasterizer(), cloud, VIEW)[1](image)
    monkeypatch.setattr(binning, "MOST_PAIRS", most_pairs)

    found = CpuRasterizer().with_sums(cloud, VIEW)[1](image)

    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_the_images_beside_the_sums_are_those_of_any_render(cloud):
    alone, (beside, _) = CpuRasterizer()(cloud, VIEW), CpuRasterizer().with_sums(cloud, VIEW)

    assert torch.equal(alone.colour, beside.colour)
    assert torch.equal(alone.depth, beside.depth)
    assert torch.equal(alone.alpha, beside.alpha)


def test_the_number_of_threads_does_not_change_a_bit_of_the_sums(cloud, image):
    first, *others = (CpuRasterizer(n).with_sums(cloud, VIEW)[1](image) for n in (1, 2, 5))

    assert all(torch.equal(first, other) for other in others)
