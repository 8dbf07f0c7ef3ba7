"""Creating a session again: fine where it means the same, refused by name where it does not."""

import dataclasses

import pytest

from services.mapping.sessions.opening import check_same, new_record
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import ConflictError
from shared.se3 import exp
from shared.tracks import OpenRequest

CALIBRATION = Calibration(Camera(Intrinsics(260.0, 260.0, 159.5, 119.5, 320, 240)), 1000.0)
REQUEST = OpenRequest("room", "offline", 3, CALIBRATION)
OTHER_CALIBRATION = dataclasses.replace(CALIBRATION, depth_scale=5000.0)
ELSEWHERE = exp([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_a_request_that_was_lost_may_come_again():
    check_same(new_record(REQUEST), dataclasses.replace(REQUEST))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"mode": "live"}, "another mode$"),
        ({"seed": 4}, "another seed$"),
        ({"calibration": OTHER_CALIBRATION}, "another calibration$"),
        ({"T_world_first": ELSEWHERE}, "another first pose$"),
        ({"seed": 4, "T_world_first": ELSEWHERE}, "another seed and first pose$"),
    ],
)
def test_a_session_with_other_settings_is_refused_by_their_names(changes, named):
    with pytest.raises(ConflictError, match=named):
        check_same(new_record(REQUEST), dataclasses.replace(REQUEST, **changes))
