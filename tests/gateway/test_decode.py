"""What a client says, checked without a gateway around it."""

import numpy as np
import pytest

from services.gateway.decode import matrix_of
from shared.errors import InputError
from shared.se3 import Pose, Quaternion, Vector3

UPRIGHT = Quaternion(0.0, 0.0, 0.0, 1.0)


def test_a_pose_near_the_origin_is_its_matrix():
    T = matrix_of(Pose(Vector3(1.0, -2.0, 9999.0), UPRIGHT), "T_map_first")

    np.testing.assert_array_equal(T[:3, 3], [1.0, -2.0, 9999.0])


@pytest.mark.parametrize("x", [5e5, -1e308, float("nan")])
def test_a_position_that_no_map_can_hold_is_refused_by_field(x):
    with pytest.raises(InputError) as caught:
        matrix_of(Pose(Vector3(x, 0.0, 0.0), UPRIGHT), "T_map_first")

    assert caught.value.field == "T_map_first.position"
