"""The mapping loss, exposure, and what they do not punish."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from services.mapping.config import LearningRates, LossConfig
from services.mapping.losses.cpu import mapping_loss_cpu
from services.mapping.losses.mapping_loss import Appearance, Target, depth_error, mapping_loss
from services.mapping.losses.ssim import ssim
from services.mapping.losses.ssim_torch import ssim_torch
from services.mapping.rasterizer import Rendered, ScreenStatistics
from services.mapping.views.appearance import IDENTITY, ExposureModel
from shared.camera import Intrinsics
from shared.rectify import RgbdImage

CAMERA = Intrinsics(20.0, 20.0, 9.5, 7.5, 20, 16)
CONFIG = LossConfig()
PLAIN = Appearance(torch.zeros(3), torch.from_numpy(IDENTITY))


@pytest.fixture
def image() -> RgbdImage:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (16, 20, 3)).astype(np.uint8)
    return RgbdImage(rgb, np.full((16, 20), 2.0, np.float32), CAMERA)


def perfect(image: RgbdImage) -> Rendered:
    colour = torch.from_numpy(image.rgb.astype(np.float32) / np.float32(255))
    depth = torch.from_numpy(image.depth_m)
    screen = ScreenStatistics(torch.zeros(0, dtype=torch.bool))
    return Rendered(colour, depth, torch.ones(16, 20), screen)


@pytest.fixture
def target(image) -> Target:
    return Target.of(image, torch.device("cpu"))


@pytest.mark.parametrize("size", [(16, 20), (15, 19)])  # the latter fills no whole vectors
def test_the_cpu_loss_and_its_gradients_equal_the_plain_ones(image, size):
    generator = torch.Generator().manual_seed(0)
    height, width = size
    holes = image.depth_m[:height, :width].copy()
    holes[3:6] = 0.0
    rgb = image.rgb[:height, :width].copy()
    target = Target.of(replace(image, rgb=rgb, depth_m=holes), torch.device("cpu"))
    results = []
    for function in (mapping_loss, mapping_loss_cpu):
        generator.manual_seed(0)
        shapes = (*size, 3), size, size, (2, 3)
        leaves = [torch.rand(shape, generator=generator).requires_grad_() for shape in shapes]
        rendered = Rendered(leaves[0], leaves[1] * 2, leaves[2], perfect(image).screen)
        appearance = Appearance(torch.tensor([0.2, 0.4, 0.6]), leaves[3])
        loss = function(rendered, target, appearance, replace(CONFIG, max_depth_error_m=1.0))
        loss.total.backward()
        results.append([loss.total, loss.squared_error, *(leaf.grad for leaf in leaves)])

    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-7)


def test_ssim_in_plain_torch_equals_the_kernels():
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(30, 40, 3, generator=generator) for _ in range(2))

    torch.testing.assert_close(ssim_torch(a, b), ssim(a, b), rtol=1e-4, atol=1e-5)


def test_a_perfect_render_has_no_loss(image, target):
    loss = mapping_loss(perfect(image), target, PLAIN, CONFIG)

    assert loss.total.item() == pytest.approx(0.0, abs=1e-5)
    assert loss.squared_error.item() == pytest.approx(0.0, abs=1e-9)


def test_the_colour_term_is_the_mean_error_and_the_weighted_mean_square(image, target):
    rendered = perfect(image)
    darker = replace(rendered, colour=rendered.colour - 0.1)

    loss = mapping_loss(darker, target, PLAIN, replace(CONFIG, ssim=0.0, square=3.0, depth=0.0))

    assert loss.total.item() == pytest.approx(0.1 + 3.0 * 0.1**2, rel=1e-5)


def test_depth_error_is_metres_where_both_depths_are_known(image, target):
    rendered = perfect(image)
    depth = rendered.depth + 0.05
    holes = target.depth.clone()
    holes[:8] = 0.0

    error = depth_error(replace(rendered, depth=depth), holes, CONFIG)

    assert error.item() == pytest.approx(0.05 / 2, rel=1e-4)


@pytest.mark.parametrize("shift_m", [0.31, -0.5])
def test_depth_that_is_far_off_is_an_outlier_of_the_sensor(image, target, shift_m):
    rendered = perfect(image)

    error = depth_error(replace(rendered, depth=rendered.depth + shift_m), target.depth, CONFIG)

    assert error.item() == 0.0


def test_the_background_shows_where_alpha_is_low():
    appearance = Appearance(torch.tensor([0.2, 0.4, 0.6]), torch.from_numpy(IDENTITY))

    image = appearance.apply(torch.zeros(1, 1, 3), torch.tensor([[0.5]]))

    torch.testing.assert_close(image[0, 0], torch.tensor([0.1, 0.2, 0.3]))


def exposures() -> ExposureModel:
    model = ExposureModel()
    for seq, t_ns in ((0, 0), (5, 1_000_000_000), (9, 3_000_000_000)):
        model.add(seq, t_ns)
    return model


def test_the_first_keyframes_exposure_stays_the_identity():
    model = exposures()

    model.step(0, np.ones((2, 3), np.float32), LearningRates())

    np.testing.assert_array_equal(model.of(0), IDENTITY)


def test_a_step_moves_gain_and_bias_by_their_rates():
    model = exposures()

    model.step(5, np.ones((2, 3), np.float32), LearningRates())

    expected = [[1 - 5e-3] * 3, [-2e-3] * 3]
    np.testing.assert_allclose(model.of(5), expected, rtol=1e-5)


def test_exposure_is_linear_between_keyframes_and_constant_outside():
    model = exposures()
    model.step(9, np.ones((2, 3), np.float32), LearningRates())

    half = model.at(2_000_000_000)

    np.testing.assert_allclose(half, (model.of(5) + model.of(9)) / 2, rtol=1e-6)
    np.testing.assert_array_equal(model.at(9_000_000_000), model.of(9))
    np.testing.assert_array_equal(model.at(-1), IDENTITY)


def test_without_a_time_the_mean_exposure_is_drawn():
    model = exposures()
    model.step(9, np.ones((2, 3), np.float32), LearningRates())

    np.testing.assert_allclose(model.at(None), (2 * IDENTITY + model.of(9)) / 3, rtol=1e-6)


def test_exposures_come_back_from_their_state():
    model, again = exposures(), ExposureModel()
    model.step(5, np.ones((2, 3), np.float32), LearningRates())

    again.restore(model.state())
    for each in (model, again):
        each.step(5, np.full((2, 3), -0.5, np.float32), LearningRates())

    np.testing.assert_array_equal(again.of(5), model.of(5))
