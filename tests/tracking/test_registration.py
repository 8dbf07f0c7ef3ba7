import numpy as np
import pytest

from services.tracking.config import RegistrationConfig, SurfaceConfig
from services.tracking.point_cloud import surface_from_depth
from services.tracking.registration import align, linearise, optimum, overlap
from services.tracking.voxel_map import build_voxel_map
from shared.se3 import angle_rad, exp, inverse
from shared.tracks import PointCloud

CONFIG = RegistrationConfig()
CORNER = exp([0.0, 0.0, 0.0, 0.4, 0.8, 0.0])  # two walls and the floor


def cloud_of(room, T_world_camera):
    image = room.view(T_world_camera)
    return surface_from_depth(image.depth_m, image.intrinsics, SurfaceConfig())


def wall(shift_m: float = 0.0) -> PointCloud:
    x, y = np.meshgrid(np.arange(-1.0, 1.0, 0.01), np.arange(-1.0, 1.0, 0.01))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0 + shift_m)], axis=1)
    normals = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (x.size, 1))
    return PointCloud(points.astype(np.float32), normals)


def test_a_level_built_from_a_finer_one_equals_that_built_from_the_points(room):
    cloud = cloud_of(room, CORNER)

    from_finer = build_voxel_map(cloud, (0.2, 0.05)).levels[0]
    from_points = build_voxel_map(cloud, (0.2,)).levels[0]

    np.testing.assert_allclose(from_finer.points, from_points.points, atol=1e-5)
    np.testing.assert_allclose(from_finer.normals, from_points.normals, atol=1e-5)


@pytest.mark.parametrize(
    "twist",
    [
        [0.01, 0.005, -0.01, 0.01, -0.005, 0.01],
        [0.05, -0.05, 0.03, 0.02, 0.03, -0.02],
        [0.15, 0.05, -0.15, 0.03, -0.1, 0.05],
    ],
)
def test_a_known_motion_is_recovered_to_a_millimetre(room, twist):
    target = build_voxel_map(cloud_of(room, CORNER), CONFIG.voxel_sizes_m)
    source = cloud_of(room, CORNER @ exp(twist))

    registration = align(source, target, np.eye(4), CONFIG)

    error = inverse(exp(twist)) @ registration.T_world_camera
    assert np.linalg.norm(error[:3, 3]) < 0.001
    assert np.degrees(angle_rad(error)) < 0.03


def test_a_wall_gives_distance_and_tilt_and_leaves_the_rest_to_the_prediction():
    target = build_voxel_map(wall(), CONFIG.voxel_sizes_m)
    start = exp([0.013, -0.007, 0.0, 0.0, 0.0, 0.004])

    registration = align(wall(0.02), target, start, CONFIG)

    np.testing.assert_allclose(
        registration.T_world_camera[:3, 3], [0.013, -0.007, -0.02], atol=1e-4
    )


def test_the_information_of_a_wall_is_nothing_along_it():
    target = build_voxel_map(wall(), CONFIG.voxel_sizes_m)

    information = linearise(wall(), target.levels[-1], np.eye(4), CONFIG).information

    across, along = information[2, 2], information[[0, 1, 5], [0, 1, 5]]
    assert along.max() < 1e-6 * across


def noisy_edge(seed: int) -> PointCloud:
    """Two walls that meet in an edge along y; their normals are some degrees off."""
    rng = np.random.default_rng(seed)
    along, off = rng.uniform(-1.0, 1.0, (2, 20000)), rng.normal(0.0, 0.05, (40000, 3))
    s = np.abs(along[1])
    left, right = np.stack([-s, along[0], 2.0 - s]), np.stack([s, along[0], 2.0 - s])
    normals = np.repeat([[1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]], 20000, axis=0) + off
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.concatenate([left.T, right.T])
    return PointCloud(points.astype(np.float32), normals.astype(np.float32))


def test_noise_in_the_normals_is_not_taken_for_information_along_an_edge():
    target = build_voxel_map(noisy_edge(0), CONFIG.voxel_sizes_m)
    start = exp([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])

    registration = align(noisy_edge(1), target, start, CONFIG)

    np.testing.assert_allclose(registration.T_world_camera[:3, 3], [0.0, 0.05, 0.0], atol=1e-3)
    assert registration.information[1, 1] < 1e-4 * registration.information[0, 0]


def test_the_gradient_points_back_to_the_optimum(room):
    target = build_voxel_map(cloud_of(room, CORNER), CONFIG.voxel_sizes_m)
    away = exp([0.002, -0.001, 0.001, 0.001, 0.0005, -0.001])

    registration = linearise(cloud_of(room, CORNER), target.levels[-1], away, CONFIG)

    assert np.linalg.norm(optimum(registration, CONFIG)[:3, 3]) < 0.0003


def test_outliers_do_not_pull(room):
    target = build_voxel_map(cloud_of(room, CORNER), CONFIG.voxel_sizes_m)
    source = cloud_of(room, CORNER)
    points = source.points.copy()
    points[::5] *= 0.98  # a fifth of the surface stands a few centimetres in front

    registration = align(PointCloud(points, source.normals), target, np.eye(4), CONFIG)

    assert np.linalg.norm(registration.T_world_camera[:3, 3]) < 0.001


def test_nothing_in_common_gives_no_overlap_and_no_step(room):
    target = build_voxel_map(wall(), CONFIG.voxel_sizes_m)
    start = exp([0.0, 0.0, -50.0, 0.0, 0.0, 0.0])

    registration = align(wall(), target, start, CONFIG)

    assert registration.overlap == 0.0
    np.testing.assert_array_equal(registration.T_world_camera, start)


def test_the_coarsest_level_shows_a_place_through_some_drift_and_no_other_place(room):
    cloud = cloud_of(room, CORNER)
    coarsest = build_voxel_map(cloud, CONFIG.voxel_sizes_m).levels[0]
    drifted, behind = exp([0.1, 0.05, -0.08, 0.0, 0.05, 0.0]), exp([0.0, 0.0, 0.0, 0.0, np.pi, 0.0])

    assert overlap(cloud, coarsest, drifted, CONFIG) > 0.8
    assert overlap(cloud, coarsest, behind, CONFIG) < 0.05


def test_the_two_sides_of_a_thin_wall_stay_apart():
    front, back = wall(), wall(0.01)
    both = PointCloud(
        np.concatenate([front.points, back.points]),
        np.concatenate([front.normals, -back.normals]),
    )

    level = build_voxel_map(both, CONFIG.voxel_sizes_m).levels[-1]

    depths = level.points[level.normals[:, 2] < 0.0, 2]
    np.testing.assert_allclose(depths, 2.0, atol=1e-5)


def test_an_empty_map_can_be_built():
    none = np.zeros((0, 3), np.float32)

    voxels = build_voxel_map(PointCloud(none, none), CONFIG.voxel_sizes_m)

    assert align(wall(), voxels, np.eye(4), CONFIG).overlap == 0.0


def test_an_empty_frame_has_no_overlap():
    none = np.zeros((0, 3), np.float32)
    voxels = build_voxel_map(wall(), CONFIG.voxel_sizes_m)

    assert align(PointCloud(none, none), voxels, np.eye(4), CONFIG).overlap == 0.0
