import gtsam
import numpy as np
import pytest

from services.mapping.keyframes.pose_graph import (
    PoseGraph,
    PoseGraphConfig,
    exp_twists,
    log_twists,
    residuals,
    solve_pose_graph,
)
from shared.errors import ConfigError
from shared.se3 import exp, inverse, log

CONFIG = PoseGraphConfig()
SIGMAS = np.array([0.01] * 3 + [0.004] * 3)


def ring(count: int) -> np.ndarray:
    """True poses of a camera that goes once around and looks outward."""
    step = exp([0.3, 0.02, 0.0, 0.0, 2.0 * np.pi / count, 0.0])
    poses = [np.eye(4)]
    while len(poses) < count:
        poses.append(poses[-1] @ step)
    return np.array(poses)


def graph(truth: np.ndarray, noise: np.ndarray, loops: list[tuple[int, int]]) -> PoseGraph:
    """Noisy steps from pose to pose, exact loops; poses start from the steps alone."""
    pairs = np.array([(k, k + 1) for k in range(len(truth) - 1)] + loops)
    measured = inverse(truth[pairs[:, 0]]) @ truth[pairs[:, 1]]
    steps = len(truth) - 1
    measured[:steps] = measured[:steps] @ exp_twists(noise)
    poses = [truth[0]]
    for step in measured[:steps]:
        poses.append(poses[-1] @ step)
    is_robust = np.arange(len(pairs)) >= steps
    information = np.where(is_robust[:, None, None], 1e6 * np.eye(6), np.diag(SIGMAS**-2))
    return PoseGraph(np.array(poses), pairs[:, 0], pairs[:, 1], measured, information, is_robust)


@pytest.fixture
def drifting() -> PoseGraph:
    noise = np.random.default_rng(1).normal(1.0, 1.0, (39, 6)) * SIGMAS
    return graph(ring(40), noise, [(0, 39), (2, 38)])


def gtsam_solution(problem: PoseGraph) -> np.ndarray:
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    turned = np.roll(np.arange(6), 3)  # gtsam has the rotation first
    anchor = gtsam.noiseModel.Isotropic.Sigma(6, 1e-9)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(problem.T_world_poses[0]), anchor))
    for e in range(len(problem.first)):
        noise = gtsam.noiseModel.Gaussian.Information(
            problem.information[e][np.ix_(turned, turned)]
        )
        if problem.is_robust[e]:
            kernel = gtsam.noiseModel.mEstimator.Huber.Create(CONFIG.huber_sigma)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        measured = gtsam.Pose3(problem.T_first_second[e])
        first, second = int(problem.first[e]), int(problem.second[e])
        factors.add(gtsam.BetweenFactorPose3(first, second, measured, noise))
    for k, pose in enumerate(problem.T_world_poses):
        values.insert(k, gtsam.Pose3(pose))
    solved = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    return np.array([solved.atPose3(k).matrix() for k in range(len(problem.T_world_poses))])


def test_many_exponentials_are_those_of_one():
    twists = np.random.default_rng(0).normal(0.0, 0.8, (20, 6))
    twists[0] = 0.0
    twists[1] *= 1e-9

    many = exp_twists(twists)

    np.testing.assert_allclose(many, [exp(twist) for twist in twists], atol=1e-12)
    np.testing.assert_allclose(log_twists(many), [log(T) for T in many], atol=1e-9)


def test_exact_loops_close():
    truth = ring(30)
    noise = np.zeros((29, 6))
    noise[14] = [0.05, -0.02, 0.03, 0.02, -0.03, 0.01]  # one bad step
    problem = graph(truth, noise, [(0, 29)])

    solved = solve_pose_graph(problem, CONFIG)

    step = inverse(solved[0]) @ solved[29]
    np.testing.assert_allclose(step, inverse(truth[0]) @ truth[29], atol=2e-3)


def test_without_loops_nothing_moves():
    chain = graph(ring(20), np.full((19, 6), 0.01), [])

    np.testing.assert_allclose(solve_pose_graph(chain, CONFIG), chain.T_world_poses, atol=1e-12)


def test_the_first_pose_stays(drifting):
    solved = solve_pose_graph(drifting, CONFIG)

    np.testing.assert_array_equal(solved[0], drifting.T_world_poses[0])


def test_the_solution_does_not_depend_on_the_world(drifting):
    T_other_world = exp([3.0, -2.0, 1.0, 0.4, -0.8, 0.3])
    moved = PoseGraph(
        **{**drifting.__dict__, "T_world_poses": T_other_world @ drifting.T_world_poses}
    )

    solved = solve_pose_graph(moved, CONFIG)

    expected = T_other_world @ solve_pose_graph(drifting, CONFIG)
    np.testing.assert_allclose(solved, expected, atol=1e-5)


def test_loops_take_most_of_the_drift_away(drifting):
    truth = ring(40)

    solved = solve_pose_graph(drifting, CONFIG)

    def error(poses: np.ndarray) -> float:
        return float(np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).mean())

    assert error(solved) < 0.5 * error(drifting.T_world_poses)


def test_the_solution_is_that_of_gtsam(drifting):
    solved = solve_pose_graph(drifting, CONFIG)

    np.testing.assert_allclose(solved, gtsam_solution(drifting), atol=2e-4)


def test_what_is_left_of_a_false_loop_gives_it_away(drifting):
    pairs = (np.append(drifting.first, 5), np.append(drifting.second, 25))
    false = PoseGraph(
        drifting.T_world_poses,
        *pairs,
        T_first_second=np.concatenate([drifting.T_first_second, np.eye(4)[None]]),
        information=np.concatenate([drifting.information, drifting.information[-1:]]),
        is_robust=np.append(drifting.is_robust, True),
    )

    solved = solve_pose_graph(false, CONFIG)

    left = residuals(PoseGraph(**{**false.__dict__, "T_world_poses": solved}))[-1]
    assert np.linalg.norm(left[:3]) > 1.0  # metres: loops that are right leave millimetres


@pytest.mark.parametrize("change", [{"iterations": 0}, {"huber_sigma": 0.0}])
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(ConfigError):
        PoseGraphConfig(**change)
