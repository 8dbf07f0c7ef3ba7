"""The CPU rasterizer against the float64 reference, values and gradients."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from services.mapping.rasterizer import CpuRasterizer, Gaussians, Rendered, View
from services.mapping.rasterizer.reference import render
from shared import se3
from shared.camera import Intrinsics

CAMERA = Intrinsics(fx=80.0, fy=82.0, cx=31.2, cy=24.4, width=64, height=48)
POSE = se3.exp([0.05, -0.03, 0.02, 0.01, 0.05, -0.02])


class Scene(NamedTuple):
    """Ranges from which a random scene is drawn; lengths in metres."""

    size: int = 200
    depth: tuple[float, float] = (0.5, 4.0)
    width_per_depth: float = 1.0
    log_scale: float = -3.0
    log_scale_spread: float = 0.8
    opacity: tuple[float, float] = (0.05, 0.95)
    thinness: float = 1.0  # length of the first axis over those of the others


SCENES = {
    "ordinary": Scene(),
    "dense": Scene(size=1500, log_scale=-3.5),
    "huge": Scene(size=20, log_scale=0.0),
    "tiny": Scene(log_scale=-7.0),
    "elongated": Scene(size=100, log_scale=-4.0, log_scale_spread=1.4),
    "needles": Scene(size=60, log_scale=-1.5, log_scale_spread=0.3, thinness=1000.0),
    "near needles": Scene(size=40, depth=(0.2, 0.5), log_scale=-2.0, thinness=1000.0),
    "opaque": Scene(size=100, opacity=(0.99, 0.999)),
    "fully opaque": Scene(size=100, opacity=(1.0, 1.0)),
    "faint": Scene(opacity=(0.0, 0.02)),
    "beside the camera": Scene(width_per_depth=8.0, log_scale=-1.0),
    "behind the camera": Scene(depth=(-2.0, 2.0)),
    "at the near plane": Scene(size=60, depth=(0.15, 0.3)),
    "single": Scene(size=1),
}


def make(scene, seed=0):
    """Five float32 tensors in the order of `Gaussians`."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator)

    z = uniform(*scene.depth, scene.size)
    half = 0.5 * scene.width_per_depth * z.abs()
    means = torch.stack([uniform(-1, 1, len(z)) * half, uniform(-1, 1, len(z)) * half, z], 1)
    spread = torch.randn(scene.size, 3, generator=generator)
    thinness = torch.tensor([1.0, scene.thinness, scene.thinness])
    return (
        means,
        torch.exp(scene.log_scale + scene.log_scale_spread * spread) / thinness,
        torch.randn(scene.size, 4, generator=generator),
        uniform(*scene.opacity, scene.size),
        uniform(0.0, 1.0, scene.size, 3),
    )


def leaves(tensors, dtype):
    return [tensor.to(dtype, copy=True).requires_grad_() for tensor in tensors]


class Twins(NamedTuple):
    """Leaves and outcome of both renderings after a backward pass with the same weights."""

    fast: Rendered
    exact: Rendered
    fast_leaves: list
    exact_leaves: list
    is_decided: torch.Tensor


def render_both(tensors, camera=CAMERA, pose=POSE):
    """Render and differentiate; undecided pixels weigh nothing. The last leaf is the pose."""
    fast = [*leaves(tensors, torch.float32), *leaves([torch.from_numpy(pose)], torch.float64)]
    exact = [*leaves(tensors, torch.float64), *leaves([torch.from_numpy(pose)], torch.float64)]
    rendered = CpuRasterizer(2)(Gaussians(*fast[:5]), View(fast[5], camera))
    reference, is_decided = render(Gaussians(*exact[:5]), View(exact[5], camera))
    generator = torch.Generator().manual_seed(1)
    for image, twin in zip(images(rendered), images(reference), strict=True):
        mask = is_decided[..., None] if image.ndim == 3 else is_decided
        weights = torch.randn(image.shape, generator=generator) * mask
        image.backward(weights, retain_graph=True)
        twin.backward(weights.double(), retain_graph=True)
    return Twins(rendered, reference, fast, exact, is_decided)


def images(rendered):
    return rendered.colour, rendered.depth, rendered.alpha


def relative_error(found, expected):
    scale = expected.detach().norm().clamp(min=1e-12)
    return ((found.detach().double() - expected.detach()).norm() / scale).item()


@pytest.fixture(scope="module", params=SCENES)
def twins(request):
    return render_both(make(SCENES[request.param]))


def test_images_equal_the_reference(twins):
    decided = twins.is_decided

    for found, expected in zip(images(twins.fast), images(twins.exact), strict=True):
        assert relative_error(found[decided], expected[decided]) < 1e-5


def test_gradients_equal_the_reference(twins):
    for found, expected in zip(twins.fast_leaves, twins.exact_leaves, strict=True):
        assert relative_error(found.grad, expected.grad) < 1e-4


def test_screen_gradient_norms_equal_the_reference(twins):
    found, expected = twins.fast.screen, twins.exact.screen

    assert relative_error(found.gradient_norm, expected.gradient_norm) < 1e-4


def test_whatever_touches_a_pixel_is_visible(twins):
    assert twins.fast.screen.visible[twins.exact.screen.visible].all()


def test_few_pixels_are_undecided(twins):
    assert twins.is_decided.double().mean() > 0.95


def test_a_wide_gaussian_beside_a_close_camera_keeps_its_gradients():
    # Without the clamp in the Jacobian this one is 500 px wide, 1000 px off the image.
    camera = Intrinsics(fx=585.0, fy=585.0, cx=319.5, cy=39.5, width=640, height=80)
    tensors = (
        torch.tensor([[0.4, 0.05, 0.21]]),
        torch.tensor([[0.2, 0.05, 0.02]]),
        torch.tensor([[1.0, 0.2, 0.3, 0.1]]),
        torch.tensor([0.7]),
        torch.tensor([[0.2, 0.5, 0.8]]),
    )

    twins = render_both(tensors, camera)

    assert twins.fast.screen.visible.all()
    for found, expected in zip(twins.fast_leaves[:3], twins.exact_leaves[:3], strict=True):
        assert relative_error(found.grad, expected.grad) < 1e-4


def test_an_image_of_many_uneven_tiles_equals_the_reference():
    camera = Intrinsics(fx=150.0, fy=150.0, cx=70.0, cy=40.0, width=135, height=99)

    twins = render_both(make(Scene(size=150, log_scale=-2.0, log_scale_spread=1.2)), camera)

    decided = twins.is_decided
    assert relative_error(twins.fast.colour[decided], twins.exact.colour[decided]) < 1e-5
    for found, expected in zip(twins.fast_leaves, twins.exact_leaves, strict=True):
        assert relative_error(found.grad, expected.grad) < 1e-4


def test_the_pose_gradient_predicts_a_small_twist():
    tensors = make(SCENES["ordinary"])
    pose = torch.from_numpy(POSE).requires_grad_()
    twist = 1e-4 * np.array([1.0, -2.0, 0.5, 0.3, -0.4, 1.0])

    def loss(T):
        reference, _ = render(Gaussians(*leaves(tensors, torch.float64)), View(T, CAMERA))
        return (reference.colour**2).mean() + 0.1 * reference.depth.mean()

    rendered = CpuRasterizer(1)(Gaussians(*tensors), View(pose, CAMERA))
    ((rendered.colour**2).mean() + 0.1 * rendered.depth.mean()).backward()
    ahead, back = (torch.from_numpy(se3.exp(sign * twist) @ POSE) for sign in (1, -1))
    generator = torch.from_numpy((se3.exp(twist) - se3.exp(-twist)) @ POSE) / 2
    gradient = pose.grad
    assert gradient is not None
    predicted = (gradient * generator).sum().item()

    # The difference also sees pixels cross ALPHA_MIN, which no gradient does.
    assert predicted == pytest.approx((loss(ahead) - loss(back)).item() / 2, rel=0.1)
    assert (gradient[3] == 0).all()
