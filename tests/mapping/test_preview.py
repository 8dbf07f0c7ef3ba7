"""The map as few plain Gaussians: a part that covers what all did."""

import numpy as np
import torch

from services.mapping.export.preview import Sample
from services.mapping.rasterizer import Gaussians


def flat(sizes, opacity=0.5, x=0.0) -> Gaussians:
    """Discs of given radii at one place."""
    count = len(sizes)
    radii = torch.as_tensor(sizes, dtype=torch.float32)
    return Gaussians(
        means=torch.full((count, 3), x),
        scales=torch.stack([radii, radii, torch.full((count,), 1e-4)], dim=1),
        quats_wxyz=torch.ones(count, 4),
        opacities=torch.full((count,), opacity),
        colours=torch.zeros(count, 3),
    )


def covered(gaussians, x):
    at = gaussians.means[:, 0] == x
    return float((gaussians.scales[at, 0] * gaussians.scales[at, 1]).sum())


def test_within_the_limit_all_that_show_are_kept_as_they_are():
    sample = Sample(10)
    sample.add(flat([0.1, 0.2]))
    sample.add(flat([0.9], opacity=0.001))

    kept = sample.grown()

    np.testing.assert_allclose(np.sort(kept.scales[:, 0].numpy()), [0.1, 0.2])


def test_a_part_covers_what_all_did_where_the_map_is_fine_and_where_it_is_coarse():
    fine, coarse = flat(np.full(8000, 0.01), x=1.0), flat(np.full(500, 0.04), x=2.0)
    sample = Sample(2000)
    sample.add(fine)
    sample.add(coarse)

    kept = sample.grown()

    assert len(kept.means) == 2000
    np.testing.assert_allclose(covered(kept, 1.0), covered(fine, 1.0), rtol=0.1)
    np.testing.assert_allclose(covered(kept, 2.0), covered(coarse, 2.0), rtol=0.1)


def test_the_same_map_gives_the_same_part():
    first, second = Sample(50), Sample(50)
    for sample in (first, second):
        sample.add(flat(np.linspace(0.01, 0.1, 500)))

    torch.testing.assert_close(first.grown().scales, second.grown().scales, rtol=0, atol=0)
