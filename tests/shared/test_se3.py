import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from shared import se3
from shared.errors import InputError
from shared.se3 import Pose, Quaternion, Vector3

twists = arrays.arrays(np.float64, 6, elements=st.floats(-1.5, 1.5))


def assert_same(a, b, atol=1e-9):
    np.testing.assert_allclose(a, b, atol=atol)


@given(twists)
def test_the_logarithm_undoes_the_exponential(twist):
    assert_same(se3.exp(se3.log(se3.exp(twist))), se3.exp(twist))


@given(twists)
def test_a_transform_times_its_inverse_is_nothing(twist):
    T = se3.exp(twist)

    assert_same(se3.inverse(T) @ T, np.eye(4))


@given(twists, twists, twists)
def test_composition_is_associative(a, b, c):
    A, B, C = se3.exp(a), se3.exp(b), se3.exp(c)

    assert_same((A @ B) @ C, A @ (B @ C))


@given(twists)
def test_rotations_have_determinant_one(twist):
    assert np.linalg.det(se3.exp(twist)[:3, :3]) == pytest.approx(1.0)


@given(twists)
def test_a_pose_names_every_component(twist):
    T = se3.exp(twist)

    assert_same(Pose.from_matrix(T).matrix(), T)


@given(twists, st.floats(0.0, 1.0))
def test_interpolation_ends_at_its_ends(twist, fraction):
    T = se3.exp(twist)

    assert_same(se3.interpolate(np.eye(4), T, 0.0), np.eye(4))
    assert_same(se3.interpolate(np.eye(4), T, 1.0), T, 1e-6)
    assert np.isfinite(se3.interpolate(np.eye(4), T, fraction)).all()


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1.0, 3.0, np.pi - 1e-9, np.pi])
def test_the_angle_of_a_rotation_is_read_back(angle):
    assert se3.angle_rad(se3.exp([0, 0, 0, 0, angle, 0])) == pytest.approx(angle, abs=1e-8)


def test_half_a_turn_has_a_logarithm():
    T = se3.exp([0.1, 0.2, 0.3, np.pi, 0.0, 0.0])

    assert_same(se3.exp(se3.log(T)), T, 1e-6)


def test_a_quarter_turn_about_z_takes_x_to_y():
    T = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2])

    assert_same(se3.transform(T, np.array([[1.0, 0.0, 0.0]])), [[0.0, 1.0, 0.0]])


def test_directions_are_not_moved():
    T = se3.exp([5.0, 5.0, 5.0, 0.0, 0.0, 0.0])

    assert_same(se3.rotate(T, np.array([[1.0, 2.0, 3.0]])), [[1.0, 2.0, 3.0]])


def test_points_keep_their_precision():
    assert se3.transform(np.eye(4), np.ones((2, 3), np.float32)).dtype == np.float32


def test_stacks_of_transforms_are_inverted_one_by_one():
    stack = np.stack([se3.exp(0.1 * k * np.ones(6)) for k in range(4)])

    assert_same(se3.inverse(stack) @ stack, np.tile(np.eye(4), (4, 1, 1)))


def test_rounding_is_taken_out_of_a_rotation():
    T = se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    rough = T.copy()
    rough[:3, :3] *= 1.0001

    assert_same(se3.orthonormalise(rough), T, 1e-6)


@pytest.mark.parametrize("scale", [1e-7, np.nan, np.inf])
def test_a_quaternion_without_length_is_refused(scale):
    pose = Pose(Vector3(0.0, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, scale))

    with pytest.raises(InputError, match="orientation"):
        pose.matrix()


def test_a_position_that_is_not_finite_is_refused():
    pose = Pose(Vector3(np.nan, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))

    with pytest.raises(InputError, match="position"):
        pose.matrix()
