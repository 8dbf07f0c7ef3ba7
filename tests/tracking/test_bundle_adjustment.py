import dataclasses

import numpy as np
import pytest

from services.tracking.bundle_adjustment import BundleProblem, pixel_chi2, solve_bundle
from services.tracking.bundle_kernels import huber_cost, linearise
from services.tracking.config import BundleAdjustmentConfig
from shared.camera import Intrinsics
from shared.se3 import exp, inverse, log, transform

CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
FOCAL = np.array([525.0, 525.0, 319.5, 239.5])
CONFIG = BundleAdjustmentConfig(iterations=20)


@dataclasses.dataclass(frozen=True)
class Scene:
    problem: BundleProblem
    true_poses: np.ndarray
    true_points: np.ndarray


def make_scene(pixel_noise: float, outliers: float = 0.0) -> Scene:
    """Six cameras side by side, 300 points, all seen by all; start off by centimetres."""
    rng = np.random.default_rng(4)
    poses = np.stack([exp([0.08 * k, 0.01 * k, 0.0, 0.0, -0.03 * k, 0.01]) for k in range(6)])
    points = rng.uniform([-1.0, -0.8, 1.5], [1.2, 0.8, 3.5], (300, 3))
    measured = np.stack([project(pose, points) for pose in poses], axis=1)
    measured[..., :2] += rng.normal(0.0, pixel_noise, measured[..., :2].shape)
    measured[..., 2] += rng.normal(0.0, 0.002 * pixel_noise, measured[..., 2].shape)
    is_wrong = rng.random(measured.shape[:2]) < outliers
    measured[is_wrong, :2] += rng.normal(0.0, 30.0, (int(is_wrong.sum()), 2))
    start = np.stack([pose @ exp(rng.normal(0.0, 0.008, 6)) for pose in poses])
    start[0] = poses[0]
    cameras, landmarks = np.meshgrid(np.arange(6), np.arange(300))
    problem = BundleProblem(
        T_world_cameras=start,
        is_fixed=np.arange(6) == 0,
        T_world_priors=start,
        pose_information=np.zeros((6, 6, 6)),
        points_world=points + rng.normal(0.0, 0.02, points.shape),
        camera_index=cameras.ravel().astype(np.int64),
        point_index=landmarks.ravel().astype(np.int64),
        measured=measured.reshape(-1, 3),
        sigmas=np.tile([1.0, 0.005], (1800, 1)),
    )
    return Scene(problem, poses, points)


def project(T_world_camera: np.ndarray, points_world: np.ndarray) -> np.ndarray:
    y = transform(inverse(T_world_camera), points_world)
    return np.column_stack([FOCAL[:2] * y[:, :2] / y[:, 2:] + FOCAL[2:], y[:, 2]])


def pose_errors_m(poses: np.ndarray, scene: Scene) -> np.ndarray:
    return np.linalg.norm(poses[:, :3, 3] - scene.true_poses[:, :3, 3], axis=1)


def test_exact_observations_give_exact_poses_and_points():
    scene = make_scene(pixel_noise=0.0)

    solution = solve_bundle(scene.problem, CAMERA, CONFIG)

    assert pose_errors_m(solution.T_world_cameras, scene).max() < 1e-5
    np.testing.assert_allclose(solution.points_world, scene.true_points, atol=1e-4)


def test_noise_and_outliers_leave_two_millimetres():
    scene = make_scene(pixel_noise=0.7, outliers=0.05)

    solution = solve_bundle(scene.problem, CAMERA, CONFIG)

    assert pose_errors_m(scene.problem.T_world_cameras, scene).max() > 0.01
    assert pose_errors_m(solution.T_world_cameras, scene).max() < 0.002


def test_what_is_of_something_else_is_far_from_where_it_should_be():
    scene = make_scene(pixel_noise=0.7, outliers=0.05)
    problem = scene.problem
    true = np.stack([project(pose, scene.true_points) for pose in scene.true_poses], axis=1)
    is_wrong = np.abs(problem.measured - true.reshape(-1, 3))[:, :2].max(axis=1) > 5.0

    chi2 = pixel_chi2(problem, solve_bundle(problem, CAMERA, CONFIG), CAMERA)

    assert is_wrong.sum() > 50
    assert (chi2[is_wrong] > CONFIG.outlier_chi2).all()
    assert (chi2[~is_wrong] > CONFIG.outlier_chi2).mean() < 0.03


def test_fixed_cameras_keep_their_bits():
    scene = make_scene(pixel_noise=0.5)

    solution = solve_bundle(scene.problem, CAMERA, CONFIG)

    np.testing.assert_array_equal(solution.T_world_cameras[0], scene.problem.T_world_cameras[0])


def test_a_firm_prior_holds_a_camera_where_it_is():
    scene = make_scene(pixel_noise=0.5)
    firm = np.zeros((6, 6, 6))
    firm[3] = 1e12 * np.eye(6)
    problem = dataclasses.replace(scene.problem, pose_information=firm)

    solution = solve_bundle(problem, CAMERA, CONFIG)

    np.testing.assert_allclose(solution.T_world_cameras[3], problem.T_world_priors[3], atol=1e-6)


def test_a_solution_is_never_worse_than_the_start():
    scene = make_scene(pixel_noise=2.0, outliers=0.5)

    solution = solve_bundle(scene.problem, CAMERA, CONFIG)

    assert solution.cost_after <= solution.cost_before


def test_the_same_problem_gives_the_same_bits():
    problem = make_scene(pixel_noise=0.7).problem

    a, b = (solve_bundle(problem, CAMERA, CONFIG) for _ in range(2))

    np.testing.assert_array_equal(a.T_world_cameras, b.T_world_cameras)
    np.testing.assert_array_equal(a.points_world, b.points_world)


def cost_at(problem: BundleProblem, poses: np.ndarray, points: np.ndarray) -> float:
    return huber_cost((inverse(poses), points), seen_in(problem), FOCAL, 2.0)


def seen_in(problem: BundleProblem) -> tuple[np.ndarray, ...]:
    p = problem
    return p.camera_index, p.point_index, p.measured, p.sigmas


def gradients(problem: BundleProblem) -> tuple[np.ndarray, np.ndarray]:
    state = (inverse(problem.T_world_cameras), problem.points_world)
    _, _, _, bc, bp = linearise(state, seen_in(problem), FOCAL, 2.0)
    return 2.0 * bc, 2.0 * bp


@pytest.mark.parametrize("axis", range(6))
def test_pose_gradients_equal_differences(axis):
    problem = make_scene(pixel_noise=1.0, outliers=0.1).problem
    step = np.zeros(6)
    step[axis] = 1e-6

    moved = [problem.T_world_cameras.copy() for _ in range(2)]
    moved[0][2] = moved[0][2] @ exp(step)
    moved[1][2] = moved[1][2] @ exp(-step)
    costs = [cost_at(problem, poses, problem.points_world) for poses in moved]

    analytic = gradients(problem)[0][2, axis]
    assert (costs[0] - costs[1]) / 2e-6 == pytest.approx(analytic, rel=1e-4)


@pytest.mark.parametrize("axis", range(3))
def test_point_gradients_equal_differences(axis):
    problem = make_scene(pixel_noise=1.0, outliers=0.1).problem
    step = np.zeros_like(problem.points_world)
    step[7, axis] = 1e-6

    costs = [
        cost_at(problem, problem.T_world_cameras, problem.points_world + sign * step)
        for sign in (1.0, -1.0)
    ]

    analytic = gradients(problem)[1][7, axis]
    assert (costs[0] - costs[1]) / 2e-6 == pytest.approx(analytic, rel=1e-4)


def test_poses_equal_those_of_gtsam():
    gtsam = pytest.importorskip("gtsam")
    scene = make_scene(pixel_noise=0.7)

    ours = solve_bundle(scene.problem, CAMERA, BundleAdjustmentConfig(huber_sigma=1e6))

    theirs = solve_with_gtsam(gtsam, scene.problem)
    apart = [log(inverse(a) @ b) for a, b in zip(ours.T_world_cameras, theirs, strict=True)]
    assert np.abs(apart).max() < 1e-4


def solve_with_gtsam(gtsam, problem: BundleProblem) -> np.ndarray:
    """The same least squares without a kernel: projection factors and depth as range along z."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    calibration = gtsam.Cal3_S2(525.0, 525.0, 0.0, 319.5, 239.5)
    pixel_noise = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    depth_noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.005)
    for k, pose in enumerate(problem.T_world_cameras):
        values.insert(gtsam.symbol("x", k), gtsam.Pose3(pose))
    for l, point in enumerate(problem.points_world):
        values.insert(gtsam.symbol("l", l), point)
    graph.add(
        gtsam.NonlinearEqualityPose3(gtsam.symbol("x", 0), values.atPose3(gtsam.symbol("x", 0)))
    )
    rows = zip(problem.camera_index, problem.point_index, problem.measured, strict=True)
    for k, l, measured in rows:
        x, point = gtsam.symbol("x", int(k)), gtsam.symbol("l", int(l))
        graph.add(
            gtsam.GenericProjectionFactorCal3_S2(measured[:2], pixel_noise, x, point, calibration)
        )
        graph.add(gtsam.CustomFactor(depth_noise, [x, point], depth_error(gtsam, measured[2])))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([result.atPose3(gtsam.symbol("x", k)).matrix() for k in range(6)])


def depth_error(gtsam, measured_m: float):
    def error(factor, values, jacobians):
        pose = values.atPose3(factor.keys()[0])
        point = values.atPoint3(factor.keys()[1])
        H_pose, H_point = np.zeros((3, 6), order="F"), np.zeros((3, 3), order="F")
        local = pose.transformTo(point, H_pose, H_point)
        if jacobians is not None:
            jacobians[0], jacobians[1] = H_pose[2:], H_point[2:]
        return np.array([local[2] - measured_m])

    return error
