import numpy as np
import pytest

from services.tracking.config import SurfaceConfig
from services.tracking.point_cloud import normals_at, surface_from_depth
from shared.camera import Intrinsics

CAMERA = Intrinsics(260.0, 260.0, 159.5, 119.5, 320, 240)
NORMAL = np.array([0.36, -0.48, -0.8])


def depth_of_plane(normal: np.ndarray, distance_m: float) -> np.ndarray:
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1
    )
    return (-distance_m / (rays @ normal)).astype(np.float32)


def test_a_tilted_plane_has_one_normal_towards_the_camera():
    cloud = surface_from_depth(depth_of_plane(NORMAL, 1.6), CAMERA, SurfaceConfig())

    assert len(cloud.points) > 1000
    np.testing.assert_allclose(cloud.normals, np.tile(NORMAL, (len(cloud.points), 1)), atol=1e-3)


def test_points_of_a_plane_lie_on_it():
    cloud = surface_from_depth(depth_of_plane(NORMAL, 1.6), CAMERA, SurfaceConfig())

    np.testing.assert_allclose(cloud.points @ NORMAL, -1.6, atol=1e-4)


def test_the_fit_averages_the_noise_of_disparity():
    noise = np.random.default_rng(0).normal(0.0, 0.005, (CAMERA.height, CAMERA.width))
    noisy = (1.0 / (0.5 + noise)).astype(np.float32)  # a wall at 2 m; sigma is 2 cm

    cloud = surface_from_depth(noisy, CAMERA, SurfaceConfig())

    assert cloud.points[:, 2].std() < 0.006


@pytest.mark.parametrize("hole", [0.0, 0.1, 9.0])
def test_pixels_without_usable_depth_give_no_points(hole):
    depth = np.full((CAMERA.height, CAMERA.width), hole, np.float32)

    assert len(surface_from_depth(depth, CAMERA, SurfaceConfig()).points) == 0


def test_no_point_hangs_between_two_surfaces():
    depth = np.full((CAMERA.height, CAMERA.width), 3.0, np.float32)
    depth[:, 160:] = 1.0

    z = surface_from_depth(depth, CAMERA, SurfaceConfig()).points[:, 2]

    assert (np.minimum(np.abs(z - 1.0), np.abs(z - 3.0)) < 1e-3).all()


def test_grazing_surfaces_are_dropped():
    grazing = np.array([np.cos(0.1), 0.0, -np.sin(0.1)])  # 84 degrees off the axis

    cloud = surface_from_depth(depth_of_plane(grazing, 0.2), CAMERA, SurfaceConfig())

    rays = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    assert (-(rays * cloud.normals).sum(axis=1) > 0.16).all()


def test_normals_at_pixels_are_zero_where_there_is_no_surface():
    depth = depth_of_plane(NORMAL, 1.6)
    depth[:, :100] = 0.0
    pixels = np.array([[20.0, 100.0], [200.0, 100.0]], np.float32)

    normals = normals_at(depth, pixels, CAMERA, SurfaceConfig())

    np.testing.assert_allclose(normals, [np.zeros(3), NORMAL], atol=1e-3)


def test_one_depth_image_gives_the_same_bits_twice():
    depth = depth_of_plane(NORMAL, 1.6)

    a = surface_from_depth(depth, CAMERA, SurfaceConfig())
    b = surface_from_depth(depth, CAMERA, SurfaceConfig())

    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.normals, b.normals)


@pytest.mark.parametrize("size", [(320, 240), (541, 363)])
def test_rows_of_the_grid_give_the_bits_of_single_pixels(size):
    rng = np.random.default_rng(3)
    camera = Intrinsics(260.0, 260.0, 159.5, 119.5, *size)
    depth = rng.uniform(1.0, 1.02, size[::-1]).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0.0
    depth[50:80, 40:90] = 0.6  # with edges

    cloud = surface_from_depth(depth, camera, SurfaceConfig())

    pixels = cloud.points[:, :2] / cloud.points[:, 2:] * 260.0 + np.array(
        [159.5, 119.5], np.float32
    )
    assert len(cloud.points) > 1000
    np.testing.assert_array_equal(
        cloud.normals, normals_at(depth, np.rint(pixels), camera, SurfaceConfig())
    )
