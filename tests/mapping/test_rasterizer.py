"""What callers of the rasterizer rely on: truths of single Gaussians, determinism, refusals."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from services.mapping.rasterizer import (
    CpuRasterizer,
    Gaussians,
    View,
    rasterizer_for,
    warm_up,
)
from shared.camera import Intrinsics
from shared.errors import ConfigError, InputError

CAMERA = Intrinsics(fx=100.0, fy=100.0, cx=20.0, cy=12.0, width=48, height=40)
VIEW = View(np.eye(4), CAMERA)


def dot(x=0.0, y=0.0, z=2.0, opacity=0.5, colour=(1.0, 0.0, 0.0), scale=0.05):
    """One round Gaussian."""
    return Gaussians(
        torch.tensor([[x, y, z]]),
        torch.full((1, 3), scale),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([opacity]),
        torch.tensor([colour]),
    )


def together(*parts):
    columns = zip(*(part.tensors() for part in parts), strict=True)
    return Gaussians(*(torch.cat(column) for column in columns))


def cloud(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) - torch.tensor([0.5, 0.5, -1.0])
    return Gaussians(
        means,
        0.005 + 0.03 * torch.rand(count, 3, generator=generator),
        torch.randn(count, 4, generator=generator),
        0.1 + 0.8 * torch.rand(count, generator=generator),
        torch.rand(count, 3, generator=generator),
    )


def trainable(gaussians):
    return Gaussians(*(tensor.clone().requires_grad_() for tensor in gaussians.tensors()))


def render_and_differentiate(rasterizer, gaussians, view=VIEW):
    """Every tensor that a training step sees."""
    leaves = trainable(gaussians)
    rendered = rasterizer(leaves, view)
    (rendered.colour.square().sum() + rendered.depth.sum() - rendered.alpha.sum()).backward()
    images = (rendered.colour, rendered.depth, rendered.alpha)
    gradients = (tensor.grad for tensor in leaves.tensors())
    return [*images, *gradients, rendered.screen.gradient_norm]


def test_a_gaussian_on_the_optical_axis_peaks_at_the_principal_point():
    rendered = CpuRasterizer()(dot(opacity=0.5), VIEW)

    assert rendered.alpha[12, 20].item() == pytest.approx(0.5, rel=1e-5)
    assert rendered.alpha.argmax().item() == 12 * 48 + 20


def test_images_are_sums_weighted_by_alpha():
    rendered = CpuRasterizer()(dot(z=2.0, opacity=0.5, colour=(1.0, 0.25, 0.0)), VIEW)

    torch.testing.assert_close(rendered.depth, 2.0 * rendered.alpha)
    torch.testing.assert_close(rendered.colour[..., 1], 0.25 * rendered.alpha)


def test_the_nearer_gaussian_hides_the_farther_whatever_their_order():
    near = dot(z=1.0, opacity=0.75, colour=(1.0, 0.0, 0.0))
    far = dot(z=2.0, opacity=0.5, colour=(0.0, 1.0, 0.0))

    for gaussians in (together(near, far), together(far, near)):
        red, green, _ = CpuRasterizer()(gaussians, VIEW).colour[12, 20].tolist()
        assert red == pytest.approx(0.75, rel=1e-4)
        assert green == pytest.approx(0.25 * 0.5, rel=1e-4)


def test_gaussians_nearer_than_the_near_plane_are_dropped():
    gaussians = together(dot(z=0.19), dot(z=-1.0), dot(z=1.0))

    rendered = CpuRasterizer()(gaussians, VIEW)

    assert rendered.screen.visible.tolist() == [False, False, True]


def test_doubling_the_resolution_keeps_positions():
    small = CpuRasterizer()(dot(x=0.1, y=0.05), VIEW).alpha
    large = CpuRasterizer()(dot(x=0.1, y=0.05), View(np.eye(4), CAMERA.scaled(2.0))).alpha

    halved = large.view(40, 2, 48, 2).mean((1, 3))

    assert halved.argmax() == small.argmax()


def test_an_empty_scene_renders_nothing_and_has_empty_gradients():
    outcome = render_and_differentiate(CpuRasterizer(), cloud(0))

    assert all((image == 0).all() for image in outcome[:3])
    assert [tensor.shape[0] for tensor in outcome[3:]] == [0] * 6


def test_gaussians_out_of_sight_get_zero_gradients():
    outcome = render_and_differentiate(CpuRasterizer(), together(dot(x=50.0), dot(z=-3.0)))

    assert all((tensor == 0).all() for tensor in outcome)


def test_finite_numbers_that_overflow_are_dropped():
    extreme = replace(dot(), means=torch.tensor([[1e30, -1e30, 1e-30]]))
    flat = replace(dot(), quats_wxyz=torch.zeros(1, 4))

    outcome = render_and_differentiate(CpuRasterizer(), together(extreme, flat, dot()))

    assert all(torch.isfinite(tensor).all() for tensor in outcome)


def test_the_number_of_threads_does_not_change_a_bit():
    outcomes = [render_and_differentiate(CpuRasterizer(n), cloud(9000)) for n in (1, 2, 5)]

    for outcome in outcomes[1:]:
        assert all(map(torch.equal, outcome, outcomes[0]))


def test_two_runs_agree_bit_by_bit():
    rasterizer = CpuRasterizer(2)

    first, second = (render_and_differentiate(rasterizer, cloud(3000)) for _ in range(2))

    assert all(map(torch.equal, first, second))


def test_python_threads_share_a_rasterizer():
    rasterizer, scenes = CpuRasterizer(2), [cloud(2000, seed) for seed in range(4)]
    expected = [render_and_differentiate(rasterizer, scene) for scene in scenes]
    found = {}

    def work(index):
        for _ in range(5):
            found[index] = render_and_differentiate(rasterizer, scenes[index])

    threads = [threading.Thread(target=work, args=(index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    for index, outcome in enumerate(expected):
        assert all(map(torch.equal, found[index], outcome))


def test_gradient_norms_appear_with_the_backward_pass():
    rendered = CpuRasterizer()(trainable(dot()), VIEW)

    before = rendered.screen.gradient_norm
    rendered.colour[12, 24, 0].backward()

    assert before is None
    assert rendered.screen.gradient_norm is not None
    assert rendered.screen.gradient_norm[0] > 0


def test_a_pose_without_gradient_may_be_an_array_or_a_tensor():
    as_array = CpuRasterizer()(dot(), VIEW)
    as_tensor = CpuRasterizer()(dot(), View(torch.eye(4, dtype=torch.float64), CAMERA))

    assert torch.equal(as_array.colour, as_tensor.colour)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("field", ["means", "scales", "quats_wxyz", "opacities", "colours"])
def test_a_number_that_is_not_finite_is_refused_by_field(field, bad):
    gaussians = cloud(20)
    getattr(gaussians, field).view(-1)[11] = bad

    with pytest.raises(InputError, match=field):
        CpuRasterizer()(gaussians, VIEW)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("scales", torch.ones(1, 2)),
        ("opacities", torch.ones(1, 1)),
        ("colours", torch.ones(2, 3)),
        ("means", torch.zeros(1, 3, dtype=torch.float64)),
    ],
)
def test_a_wrong_shape_or_type_is_refused_by_field(field, value):
    with pytest.raises(InputError, match=field):
        CpuRasterizer()(replace(dot(), **{field: value}), VIEW)


@pytest.mark.parametrize("pose", [np.eye(3), np.full((4, 4), np.nan)])
def test_a_pose_that_is_none_is_refused(pose):
    with pytest.raises(InputError, match="T_camera_world"):
        CpuRasterizer()(dot(), View(pose, CAMERA))


def test_the_device_picks_the_backend():
    warm_up()

    assert isinstance(rasterizer_for("cpu"), CpuRasterizer)
    with pytest.raises(ConfigError, match="cpu"):
        rasterizer_for("tpu")


def test_a_second_backward_pass_gives_the_same_gradients():
    leaves = trainable(cloud(3000))
    total = CpuRasterizer()(leaves, VIEW).colour.square().sum()

    first = torch.autograd.grad(total, leaves.tensors(), retain_graph=True)
    second = torch.autograd.grad(total, leaves.tensors())

    assert all(map(torch.equal, first, second))
