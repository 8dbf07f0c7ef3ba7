"""Things that move otherwise than the map: fixed to the camera, or coming into its free space."""

import numpy as np
import pytest

from benchmarks.disturbances import CarriedPlane, MovingBox
from services.tracking.config import MovingConfig, TrackingConfig
from services.tracking.executors import NoHelper
from services.tracking.observed import EncodedImages, observe
from services.tracking.stopwatch import Stopwatch
from services.tracking.surfaces import surfaces_of
from shared.frames import TrackingStatus
from shared.free_space import seen_through
from shared.pixel_cells import pixels_of
from shared.se3 import exp, inverse
from shared.tracks import MOVING

CORNER = exp([0.0, 0.0, 0.0, 0.4, 0.8, 0.0])
STEP = np.array([0.015, -0.005, 0.01, 0.004, 0.008, -0.003])
COUNT = 25


class Walk:
    """A walk through the room as a sequence."""

    def __init__(self, room, step: np.ndarray = STEP) -> None:
        self.calibration = room.calibration
        self._room = room
        self._step = step

    def __len__(self) -> int:
        return COUNT

    def true_pose(self, index: int) -> np.ndarray:
        return CORNER @ exp(index * self._step)

    def frame(self, index: int):
        return self._room.frame(index, self.true_pose(index))


def errors_m(results, walk) -> list[float]:
    T_first = walk.true_pose(0)
    off = [
        inverse(inverse(T_first) @ walk.true_pose(i)) @ result.T_world_camera
        for i, result in enumerate(results)
    ]
    return [float(np.linalg.norm(T[:3, 3])) for T in off]


def points_of_board(keyframe, share: float) -> np.ndarray:
    """Points of a keyframe's cloud in the middle of the image, at the board's depth."""
    points = keyframe.cloud_camera.points
    slopes = np.abs(points[:, :2] / points[:, 2:])
    limits = 0.5 * np.sqrt(share) * np.array([320.0, 240.0]) / 260.0
    return points[(slopes < limits).all(axis=1) & (points[:, 2] < 0.7)]


@pytest.fixture(scope="module", params=[0, 6], ids=["from the start", "from the seventh frame on"])
def carried(request, room, new_session):
    """Results behind a board that is fixed to the camera, and the walk."""
    session, walk = new_session(), CarriedPlane(Walk(room), from_index=request.param)
    return [session.track(walk.frame(i)) for i in range(COUNT)], walk


def test_a_board_fixed_to_the_camera_over_a_third_of_the_image_is_not_followed(carried):
    results, walk = carried

    assert {result.status for result in results} == {TrackingStatus.TRACKED}
    assert max(errors_m(results, walk)) < 0.01


def test_what_goes_with_the_camera_is_no_part_of_the_map_once_the_camera_has_moved(carried):
    results, _ = carried

    later = [result.keyframe for result in results[1:] if result.keyframe is not None]
    assert len(later) >= 2
    for keyframe in later:
        assert len(points_of_board(keyframe, 0.36)) == 0


def test_what_goes_with_the_camera_is_remembered_as_moving(carried):
    results, _ = carried

    last = [result.keyframe for result in results if result.keyframe is not None][-1]
    assert (last.observations.landmark_ids == MOVING).sum() >= MovingConfig().min_still


def test_a_keyframe_tells_the_pixels_of_what_goes_with_the_camera(carried):
    results, walk = carried

    keyframes = [result.keyframe for result in results if result.keyframe is not None]
    assert keyframes[0].moving_cells is None
    size = walk.calibration.colour.intrinsics
    for keyframe in keyframes[1:]:
        if keyframe.observations.landmark_ids.min() <= MOVING:
            mask = pixels_of(keyframe.moving_cells, size.height, size.width)
            assert mask[size.height // 2, size.width // 2]
            assert 0.3 < mask.mean() < 0.6


def test_a_board_over_half_of_the_image_is_not_followed(room, session):
    walk = CarriedPlane(Walk(room), share=0.5)

    results = [session.track(walk.frame(i)) for i in range(COUNT)]

    assert max(errors_m(results, walk)) < 0.02


def test_a_camera_that_stands_behind_its_board_stands(room, session):
    walk = CarriedPlane(Walk(room, step=np.zeros(6)))

    results = [session.track(walk.frame(i)) for i in range(5)]

    assert {result.status for result in results} == {TrackingStatus.TRACKED}
    assert max(errors_m(results, walk)) < 1e-3


def test_a_thing_that_moves_before_a_standing_camera_does_not_move_it(room, session):
    walk = MovingBox(Walk(room, step=np.zeros(6)), depth_m=1.0, step_px=10.0)

    results = [session.track(walk.frame(i)) for i in range(12)]

    assert {result.status for result in results} == {TrackingStatus.TRACKED}
    assert max(errors_m(results, walk)) < 0.005


def test_surfaces_part_where_the_depth_jumps():
    depth_m = np.full((48, 64), 2.0, np.float32)
    depth_m[8:40, 16:48] = 1.0
    depth_m[:, 60:] = 0.0

    surfaces = surfaces_of(depth_m, grid_px=40, max_jump=0.05)

    assert surfaces.count == 3
    chosen = np.arange(surfaces.count) == surfaces.labels[6, 8]
    assert surfaces.median_m(chosen) == 1.0
    mask = surfaces.mask(chosen, depth_m.shape)
    assert mask[8:40, 16:48].all() and not mask[:, :8].any()


def test_what_is_left_out_second_leaves_out_the_first_as_well(room):
    frame = room.frame(0, CORNER)
    images = EncodedImages(frame.rgb, frame.depth, room.calibration)
    observed = observe(images, TrackingConfig(), Stopwatch(), NoHelper())
    left, right = np.zeros((2, *observed.depth_m.shape), bool)
    left[:, :80], right[:, -80:] = True, True

    once = observed.without(left)
    both = once.without(right)

    first = len(once.moving.octaves)
    assert 0 < first < len(both.moving.octaves)
    np.testing.assert_array_equal(both.moving.keypoints_px[:first], once.moving.keypoints_px)
    u = np.rint(both.features.keypoints_px[:, 0])
    assert ((u >= 80) & (u < left.shape[1] - 80)).all()


def wall(z_m: float) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 80), np.linspace(-1.0, 1.0, 80))
    return np.stack([x, y, np.full(x.shape, z_m)], axis=-1).reshape(-1, 3).astype(np.float32)


def test_space_is_free_before_a_wall_and_not_at_it_behind_it_or_beside_it():
    free = seen_through(wall(2.0), np.eye(4))

    points = [[0.0, 0.0, 1.0], [0.0, 0.0, 1.99], [0.0, 0.0, 2.5], [5.0, 0.0, 4.0], [0.0, 0.0, -1.0]]
    verdicts = free.verdicts(np.array(points, np.float32), np.eye(4))

    assert verdicts.tolist() == [1, -1, -1, 0, 0]


def test_space_between_two_points_of_a_near_surface_is_not_free():
    near, far = wall(0.8)[::3], wall(4.0)

    free = seen_through(np.concatenate([near, np.float32(4.0) * far]), np.eye(4))

    assert (free.verdicts(wall(0.78), np.eye(4)) <= 0).all()
