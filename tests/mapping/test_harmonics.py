"""Spherical harmonics: laws of the basis, and fits to what was seen."""

from __future__ import annotations

import pytest
import torch

from services.mapping.export.harmonics import LeastSquares, basis


@pytest.fixture
def sphere() -> torch.Tensor:
    """Directions that cover the sphere evenly (a Fibonacci lattice), [N, 3]."""
    i = torch.arange(20_000, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * i / len(i), i * torch.pi * (1 + 5**0.5)
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), z], dim=1)


def test_the_basis_is_orthonormal_over_the_sphere(sphere):
    functions = basis(sphere, 3)

    products = 4 * torch.pi * functions.T @ functions / len(sphere)

    torch.testing.assert_close(products, torch.eye(16, dtype=torch.float64), atol=1e-3, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_lower_degree_is_the_beginning_of_a_higher_one(sphere, degree):
    assert torch.equal(basis(sphere, degree), basis(sphere, 3)[:, : (degree + 1) ** 2])


def test_a_fit_finds_the_coefficients_behind_what_was_seen(sphere):
    expected = torch.randn(2, 16, 3, generator=torch.Generator().manual_seed(0))
    fit = LeastSquares(2, 3, 3, ridge=1e-6)

    for direction in sphere[::200].float():
        seen = torch.einsum("b,nbc->nc", basis(direction[None], 3)[0], expected)
        fit.add(torch.arange(2), direction.expand(2, 3), seen, torch.ones(2))

    torch.testing.assert_close(fit.solve(), expected, atol=1e-3, rtol=0)


def test_directions_that_nobody_saw_stay_near_the_colour_that_was_seen(sphere):
    fit = LeastSquares(1, 3, 3, ridge=0.01)
    generator = torch.Generator().manual_seed(0)
    for _ in range(24):
        near = torch.tensor([[0.0, 0.0, 1.0]]) + 0.1 * torch.randn(1, 3, generator=generator)
        noise = 0.02 * torch.randn(1, 3, generator=generator)
        fit.add(torch.zeros(1, dtype=torch.int64), near, 0.3 + noise, torch.ones(1))

    everywhere = basis(sphere.float(), 3) @ fit.solve()[0]

    assert (everywhere - 0.3).abs().max() < 0.4


def test_what_was_never_seen_has_no_colour_of_its_own():
    assert LeastSquares(3, 3, 2, ridge=0.01).solve().abs().max() == 0.0
