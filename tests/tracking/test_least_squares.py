import dataclasses

import numpy as np
import pytest

from services.tracking.config import RefinementConfig
from services.tracking.least_squares import PoseObservations, linear_system, refine_pose
from services.tracking.registration import Registration
from shared.camera import Intrinsics
from shared.se3 import angle_rad, exp, inverse, transform

CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
FOCAL = np.array([525.0, 525.0, 319.5, 239.5])
CONFIG = RefinementConfig()
T_TRUE = exp([0.1, -0.2, 0.05, 0.1, 0.2, -0.1])
T_START = T_TRUE @ exp([0.02, -0.01, 0.02, 0.01, -0.01, 0.01])


def observations(pixel_noise: float = 0.0, outliers: float = 0.0) -> PoseObservations:
    """200 points before the true camera; half have normals, a quarter have no depth."""
    rng = np.random.default_rng(2)
    camera_points = rng.uniform([-1.0, -0.7, 1.0], [1.0, 0.7, 4.0], (200, 3))
    pixels = FOCAL[:2] * camera_points[:, :2] / camera_points[:, 2:] + FOCAL[2:]
    pixels += rng.normal(0.0, pixel_noise, pixels.shape)
    is_wrong = rng.random(200) < outliers
    pixels[is_wrong] += rng.normal(0.0, 40.0, (int(is_wrong.sum()), 2))
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[::2] = 0.0
    depths = camera_points[:, 2] + 0.002 * pixel_noise * rng.normal(size=200)
    depths[::4] = 0.0
    return PoseObservations(
        points_world=transform(T_TRUE, camera_points),
        normals_world=normals,
        keypoints_px=pixels,
        pixel_sigmas=np.ones(200),
        depths_m=depths,
        depth_sigmas_m=np.full(200, 0.01),
    )


def prior(T: np.ndarray, information: np.ndarray) -> Registration:
    return Registration(T, information, np.zeros(6), overlap=1.0, residual_scale=1.0)


NO_PRIOR = prior(np.eye(4), np.zeros((6, 6)))


def distance_m(T: np.ndarray) -> float:
    return float(np.linalg.norm((inverse(T_TRUE) @ T)[:3, 3]))


def test_exact_features_give_the_exact_pose():
    refinement = refine_pose(observations(), NO_PRIOR, T_START, CAMERA, CONFIG)

    np.testing.assert_allclose(refinement.T_world_camera, T_TRUE, atol=1e-6)
    assert refinement.is_inlier.all()


def test_outliers_are_named_and_do_not_pull():
    seen = observations(pixel_noise=0.5, outliers=0.3)

    refinement = refine_pose(seen, NO_PRIOR, T_START, CAMERA, CONFIG)

    assert distance_m(refinement.T_world_camera) < 0.002
    assert 0.6 < refinement.is_inlier.mean() < 0.8


def test_without_features_the_registration_stands():
    none = PoseObservations(**{k: v[:0] for k, v in observations().__dict__.items()})

    refinement = refine_pose(none, prior(T_TRUE, 1e6 * np.eye(6)), T_START, CAMERA, CONFIG)

    np.testing.assert_allclose(refinement.T_world_camera, T_TRUE, atol=1e-6)


def test_features_rule_along_what_the_registration_cannot_see():
    """A registration sure of all but x, which is 5 cm off: features put it right."""
    information = 1e8 * np.eye(6)
    information[0, 0] = 0.0
    slid = T_TRUE @ exp([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])

    refinement = refine_pose(observations(0.5), prior(slid, information), slid, CAMERA, CONFIG)

    assert distance_m(refinement.T_world_camera) < 0.002


def test_a_firm_registration_outweighs_noisy_features():
    seen = observations(pixel_noise=3.0)

    refinement = refine_pose(seen, prior(T_TRUE, 1e10 * np.eye(6)), T_TRUE, CAMERA, CONFIG)

    assert distance_m(refinement.T_world_camera) < 1e-4
    assert angle_rad(inverse(T_TRUE) @ refinement.T_world_camera) < 1e-4


@pytest.mark.parametrize("axis", range(6))
def test_the_gradient_equals_differences(axis):
    seen = observations(pixel_noise=1.0, outliers=0.1)
    used = np.ones(200, np.bool_)
    step = np.zeros(6)
    step[axis] = 1e-6

    ahead, back = (
        linear_system(seen, used, T_START @ exp(sign * step), FOCAL, CONFIG)[2]
        for sign in (1.0, -1.0)
    )

    _, b, _ = linear_system(seen, used, T_START, FOCAL, CONFIG)
    assert (ahead - back) / 2e-6 == pytest.approx(2.0 * b[axis], rel=1e-4)


def test_points_behind_the_camera_are_no_inliers():
    seen = observations()
    turned = dataclasses.replace(seen, points_world=seen.points_world - 100.0 * T_TRUE[:3, 2])

    refinement = refine_pose(turned, prior(T_TRUE, 1e8 * np.eye(6)), T_TRUE, CAMERA, CONFIG)

    assert not refinement.is_inlier.any()
