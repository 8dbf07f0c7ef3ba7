"""Random scenes of every kind against the float64 reference."""

import random

import numpy as np
import pytest
import torch

from services.mapping.rasterizer import CpuRasterizer, Gaussians, View
from services.mapping.rasterizer.reference import render
from shared.camera import Intrinsics

CAMERA = Intrinsics(fx=45.0, fy=50.0, cx=22.3, cy=19.8, width=47, height=41)
VIEW = View(np.eye(4), CAMERA)

# A coarse scale keeps a scene explainable; the seeded noise within it covers the rest.
CHOICES = {
    "size": range(1, 61),
    "nearest_m": [-1.0, 0.19, 0.3, 1.0],
    "depth_range_m": [0.02, 1.0, 5.0],
    "log_scale": [-7.0, -4.0, -2.5, -1.0],
    "elongation": [0.0, 0.7, 1.4],
    "thinness": [1.0, 30.0, 1000.0],
    "opacity": [(0.0, 0.01), (0.02, 0.9), (0.99, 0.999), (1.0, 1.0)],
    "spread": [0.3, 1.0, 4.0],
}


def scene_of(number):
    """One of many scenes, the same wherever and after whatever it is drawn."""
    rng = random.Random(number)
    return {"seed": number} | {name: rng.choice(choices) for name, choices in CHOICES.items()}


def make(scene):
    generator = torch.Generator().manual_seed(scene["seed"])
    size, (low, high) = scene["size"], scene["opacity"]

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    z = scene["nearest_m"] + scene["depth_range_m"] * uniform(size)
    xy = scene["spread"] * (uniform(size, 2) - 0.5) * z.abs()[:, None]
    noise = torch.randn(size, 3, generator=generator)
    thin = torch.tensor([1.0, scene["thinness"], scene["thinness"]])
    return [
        torch.cat([xy, z[:, None]], dim=1),
        torch.exp(scene["log_scale"] + scene["elongation"] * noise) / thin,
        torch.randn(size, 4, generator=generator),
        low + (high - low) * uniform(size),
        uniform(size, 3),
    ]


def gradient(leaf):
    assert leaf.grad is not None
    return leaf.grad


def differentiate(rendered, is_decided):
    """Gradients of a fixed random functional of the pixels that no threshold may flip."""
    generator = torch.Generator().manual_seed(0)
    total = torch.zeros(())
    for image in (rendered.colour, rendered.depth, rendered.alpha):
        weights = torch.randn(image.shape, generator=generator)
        total = total + (image * weights)[is_decided].sum()
    total.backward()


@pytest.mark.parametrize("scene", [scene_of(number) for number in range(40)], ids=range(40))
def test_any_scene_equals_the_reference_in_values_and_gradients(scene):
    tensors = make(scene)
    fast = [tensor.clone().requires_grad_() for tensor in tensors]
    exact = [tensor.double().requires_grad_() for tensor in tensors]

    rendered = CpuRasterizer(2)(Gaussians(*fast), VIEW)
    reference, is_decided = render(Gaussians(*exact), VIEW)
    differentiate(rendered, is_decided)
    differentiate(reference, is_decided)

    expected = reference.colour.detach()[is_decided]
    error = (rendered.colour.detach()[is_decided] - expected).norm()
    assert error <= 1e-4 * expected.norm() + 1e-6
    # The gradient at the rotation of a sphere is 0: round-off is judged beside the others.
    largest = max(gradient(twin).norm() for twin in exact)
    for found, twin in zip(fast, exact, strict=True):
        error = (gradient(found) - gradient(twin)).norm()
        assert error <= 1e-4 * gradient(twin).norm() + 1e-5 * largest + 1e-7
