"""The map as few plain Gaussians: those that cover most, within a limit."""

import numpy as np
import pytest
import torch

from services.mapping.export.preview import _covering_most
from services.mapping.rasterizer import Gaussians


def gaussians(opacities, sizes) -> Gaussians:
    count = len(sizes)
    return Gaussians(
        means=torch.arange(count).float()[:, None].expand(count, 3),
        scales=torch.tensor(sizes)[:, None].expand(count, 3),
        quats_wxyz=torch.ones(count, 4),
        opacities=torch.tensor(opacities),
        colours=torch.zeros(count, 3),
    )


@pytest.mark.parametrize(("limit", "kept"), [(1, [2]), (3, [0, 2, 3]), (9, [0, 2, 3])])
def test_the_largest_that_show_are_kept_across_blocks(limit, kept):
    first = gaussians([0.5, 0.001], [0.1, 0.9])
    later = gaussians([0.9, 0.5], [0.5, 0.05])

    most = _covering_most(first, later, limit)

    sizes = np.sort(most.scales[:, 0].numpy())[::-1]
    expected = [[0.1, 0.9, 0.5, 0.05][i] for i in kept]
    np.testing.assert_allclose(sizes, sorted(expected, reverse=True))
