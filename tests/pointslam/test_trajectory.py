"""Trajectory errors: known transforms give known numbers, and evo agrees."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D

from pointslam.evaluation.trajectory import absolute_errors, relative_errors
from shared import se3


def walk(num: int, seed: int = 0) -> dict[int, se3.Matrix]:
    """A smooth random path."""
    rng = np.random.default_rng(seed)
    T, poses = np.eye(4), {}
    for i in range(num):
        T = T @ se3.exp(rng.normal(0, [0.03, 0.03, 0.03, 0.02, 0.02, 0.02]))
        poses[i] = T
    return poses


def noisy(poses: dict[int, se3.Matrix], sigma: float) -> dict[int, se3.Matrix]:
    rng = np.random.default_rng(9)
    return {i: T @ se3.exp(rng.normal(0, sigma, 6)) for i, T in poses.items()}


def test_a_moved_world_is_no_error():
    truth = walk(80)
    T_map_truth = se3.exp([1.0, -2.0, 0.5, 0.4, -0.3, 1.2])
    estimated = {i: T_map_truth @ T for i, T in truth.items()}

    errors = absolute_errors(estimated, truth)

    assert errors is not None
    assert errors.rmse_m < 1e-9
    np.testing.assert_allclose(errors.T_truth_map, se3.inverse(T_map_truth), atol=1e-9)


def test_a_wrong_scale_is_an_error():
    truth = walk(80)
    estimated = {i: se3.from_rotation(T[:3, :3], 1.1 * T[:3, 3]) for i, T in truth.items()}

    errors = absolute_errors(estimated, truth)

    assert errors is not None and errors.rmse_m > 1e-3


def test_ate_equals_evos():
    truth = walk(60)
    estimated = noisy(truth, 0.01)
    theirs = PosePath3D(poses_se3=list(truth.values()))
    ours = PosePath3D(poses_se3=list(estimated.values()))
    ours.align(theirs)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((theirs, ours))

    errors = absolute_errors(estimated, truth)

    assert errors is not None
    assert errors.rmse_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse))
    assert errors.mean_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.mean))


@pytest.mark.parametrize(
    ("relation", "name"),
    [
        (metrics.PoseRelation.translation_part, "translation_rmse_m"),
        (metrics.PoseRelation.rotation_angle_deg, "rotation_rmse_deg"),
    ],
)
def test_rpe_equals_evos(relation, name):
    truth = walk(60)
    estimated = noisy(truth, 0.01)
    rpe = metrics.RPE(relation, delta=30, delta_unit=metrics.Unit.frames, all_pairs=True)
    paths = [PosePath3D(poses_se3=list(p.values())) for p in (truth, estimated)]
    rpe.process_data((paths[0], paths[1]))

    errors = relative_errors(estimated, truth, 30)

    assert errors is not None
    expected = rpe.get_statistic(metrics.StatisticsType.rmse)
    assert getattr(errors, name) == pytest.approx(expected)


def test_frames_are_compared_by_index():
    truth = walk(50)
    estimated = {i: T for i, T in truth.items() if i % 3}

    errors = absolute_errors(estimated, truth)

    assert errors is not None
    assert errors.rmse_m < 1e-9
    assert 3 not in errors.indices


def test_rpe_skips_pairs_with_a_lost_frame():
    truth = walk(40)
    estimated = {i: T for i, T in truth.items() if i != 35}

    errors = relative_errors(estimated, truth, 30)

    assert errors is not None and 5 not in errors.indices and len(errors.indices) == 9


def test_without_truth_there_are_no_errors():
    assert absolute_errors(walk(10), {}) is None
    assert relative_errors(walk(10), {}) is None


def test_a_camera_that_stays_in_place_is_aligned_by_its_first_pose():
    truth = {i: se3.exp([1, 2, 3, 0, 0, 0.1 * i]) for i in range(5)}
    estimated = {i: se3.inverse(truth[0]) @ T for i, T in truth.items()}

    errors = absolute_errors(estimated, truth)

    assert errors is not None
    np.testing.assert_allclose(errors.T_truth_map, truth[0], atol=1e-12)
