"""Image scores against hand-made pictures and a slow reference."""

from __future__ import annotations

import numpy as np
import pytest

from pointslam.evaluation.images import depth_l1_m, masked, psnr_db, ssim

RNG = np.random.default_rng(3)
PICTURE = RNG.integers(0, 256, (24, 32, 3), np.uint8)


def reference_ssim(x, y):
    """The formula, window by window, zeros outside."""
    offsets = np.arange(11) - 5
    kernel = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(kernel, kernel) / kernel.sum() ** 2
    values = []
    for channel in range(3):
        a, b = (np.pad(i[..., channel] / 255.0, 5) for i in (x, y))
        for row in range(x.shape[0]):
            for column in range(x.shape[1]):
                p = a[row : row + 11, column : column + 11]
                q = b[row : row + 11, column : column + 11]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * p * p).sum() - mp**2, (window * q * q).sum() - mq**2
                cov = (window * p * q).sum() - mp * mq
                luminance = (2 * mp * mq + 1e-4) / (mp**2 + mq**2 + 1e-4)
                values.append(luminance * (2 * cov + 9e-4) / (vp + vq + 9e-4))
    return np.mean(values)


def test_psnr_of_one_grey_level_off_everywhere():
    other = np.full((8, 8, 3), 100, np.uint8)

    assert psnr_db(other, other + 1) == pytest.approx(20 * np.log10(255))


def test_identical_pictures_score_100_db_and_ssim_1():
    assert psnr_db(PICTURE, PICTURE) == 100.0
    assert ssim(PICTURE, PICTURE) == pytest.approx(1.0, abs=1e-4)


def test_psnr_of_a_mask_ignores_the_rest():
    other = PICTURE.copy()
    other[:, :16] = 0
    right = np.zeros((24, 32), bool)
    right[:, 16:] = True

    assert psnr_db(other, PICTURE, right) == 100.0
    assert psnr_db(other, PICTURE, np.zeros((24, 32), bool)) is None


def test_ssim_equals_the_formula():
    other = np.clip(PICTURE.astype(int) + RNG.integers(-40, 41, PICTURE.shape), 0, 255)
    other = other.astype(np.uint8)

    assert ssim(other, PICTURE) == pytest.approx(reference_ssim(other, PICTURE), abs=1e-4)


def test_depth_error_counts_valid_truth_under_an_opaque_map():
    truth = np.array([[1.0, 2.0, 0.0, 4.0]], np.float32)
    rendered = np.array([[1.1, 2.5, 9.0, 9.0]], np.float32)
    alpha = np.array([[255, 200, 255, 100]], np.uint8)

    assert depth_l1_m(rendered, alpha, truth) == pytest.approx(0.3)
    assert depth_l1_m(rendered, alpha, np.zeros_like(truth)) is None


def test_pixels_without_depth_are_black_in_the_masked_picture():
    depth_m = np.zeros((24, 32), np.float32)
    depth_m[0, 0] = 1.0

    picture = masked(PICTURE, depth_m)

    assert (picture[0, 0] == PICTURE[0, 0]).all()
    assert picture.sum() == PICTURE[0, 0].sum()
