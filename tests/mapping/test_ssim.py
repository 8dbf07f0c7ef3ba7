"""Fused SSIM against its definition in float64 torch."""

import pytest
import torch

from services.mapping.losses.ssim import SsimTarget, ssim
from shared.errors import InputError


def _definition(image, target):
    offsets = torch.arange(11, dtype=torch.float64) - 5
    taps = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = (taps[:, None] * taps / taps.sum() ** 2).expand(3, 1, 11, 11)

    def blurred(planes):
        return torch.nn.functional.conv2d(planes, window, padding=5, groups=3)

    x, y = (planes.double().permute(2, 0, 1)[None] for planes in (image, target))
    mx, my = blurred(x), blurred(y)
    vx, vy, vxy = blurred(x * x) - mx**2, blurred(y * y) - my**2, blurred(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean()


def _pair(height, width, noise=0.1):
    generator = torch.Generator().manual_seed(3)
    target = 0.3 + 0.4 * torch.rand(height, width, 3, generator=generator)
    image = target + noise * torch.randn(height, width, 3, generator=generator)
    return image.clamp(0, 1), target


@pytest.mark.parametrize("size", [(5, 7), (16, 16), (33, 70), (61, 40)])
def test_value_and_gradient_equal_the_definition(size):
    image, target = _pair(*size)
    fast, exact = image.clone().requires_grad_(), image.double().requires_grad_()

    value, expected = ssim(fast, target), _definition(exact, target)
    (3.0 * value).backward()
    (3.0 * expected).backward()

    assert value.item() == pytest.approx(expected.item(), abs=1e-6)
    assert fast.grad is not None and exact.grad is not None
    assert (fast.grad - exact.grad).norm() < 1e-5 * exact.grad.norm()


def test_an_image_is_entirely_similar_to_itself():
    image, _ = _pair(20, 24)

    assert ssim(image, image).item() == pytest.approx(1.0, abs=1e-6)


def test_a_flat_image_has_a_finite_gradient():
    image = torch.zeros(16, 16, 3, requires_grad=True)

    ssim(image, torch.ones(16, 16, 3)).backward()

    assert image.grad is not None and torch.isfinite(image.grad).all()


def test_a_prepared_target_gives_the_same_bits():
    image, target = _pair(40, 50)

    assert ssim(image, SsimTarget.of(target)) == ssim(image, target)


def test_the_number_of_threads_does_not_change_a_bit():
    image, target = _pair(64, 48)
    results = []

    for threads in (1, 2, 3):
        leaf = image.clone().requires_grad_()
        value = ssim(leaf, target, threads)
        value.backward()
        results.append((value.item(), leaf.grad))

    assert all(value == results[0][0] for value, _ in results)
    assert all(torch.equal(gradient, results[0][1]) for _, gradient in results)


def test_a_permuted_image_is_read_in_its_own_order():
    image, target = _pair(18, 26)
    planes = image.permute(2, 0, 1).contiguous()

    assert ssim(planes.permute(1, 2, 0), target) == ssim(image, target)


@pytest.mark.parametrize(
    ("image", "field"),
    [
        (torch.zeros(16, 16), "image"),
        (torch.zeros(16, 16, 3, dtype=torch.float64), "image"),
        (torch.zeros(16, 17, 3), "image"),
    ],
)
def test_an_image_that_does_not_fit_is_refused(image, field):
    with pytest.raises(InputError, match=field):
        ssim(image, torch.zeros(16, 16, 3))
