"""The procedural room: its truth is exact, its noise is a Kinect's, its folder is readable."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pointslam.datasets import open_sequence
from pointslam.synth import SynthOptions, record_scene
from pointslam.synth.kinect import KinectNoise, measure_depth
from pointslam.synth.lighting import bake_light
from pointslam.synth.path import camera_path, look
from pointslam.synth.render import render_depth
from pointslam.synth.room import SIZE_M, build_room
from pointslam.synth.scene import pack_scene
from pointslam.synth.surfaces import UP, Facing, panel
from shared import se3
from shared.camera import Intrinsics
from shared.errors import ConfigError
from shared.frames import Frame
from shared.rectify import rectify

SMALL = Intrinsics(131.25, 131.25, 79.5, 59.5, 160, 120)


def rectified(sequence, index):
    frame = sequence.frame(index)
    return rectify(Frame(0, 0, frame.rgb, frame.depth), sequence.calibration)


def test_a_recording_is_a_readable_sequence_with_views(room):
    assert len(room) == 34
    assert room.num_views == 2
    assert room.rate_hz == pytest.approx(30.0, rel=1e-4)


def test_depth_and_poses_agree_between_frames(room):
    first, second = rectified(room, 0), rectified(room, 4)
    v, u = np.mgrid[10:110:7, 10:150:7].reshape(2, -1)
    z = first.depth_m[v, u]
    rays = np.c_[(u - SMALL.cx) / SMALL.fx, (v - SMALL.cy) / SMALL.fy, np.ones(len(u))]
    T_second_first = se3.inverse(room.truth(4)) @ room.truth(0)

    moved = se3.transform(T_second_first, rays * z[:, None])
    pixels = (moved[:, :2] / moved[:, 2:] * SMALL.fx + [SMALL.cx, SMALL.cy]).astype(np.float32)
    seen = cv2.remap(second.depth_m, pixels[:, None, 0], pixels[:, None, 1], cv2.INTER_NEAREST)

    inside = seen[:, 0] > 0
    error_m = np.abs(seen[inside, 0] - moved[inside, 2])
    assert inside.mean() > 0.8
    assert np.median(error_m) < 0.005


def test_colour_has_the_detail_that_features_need(room):
    grey = cv2.cvtColor(rectified(room, 0).rgb, cv2.COLOR_RGB2GRAY)

    assert len(cv2.ORB.create(500, nlevels=2).detect(grey, None)) > 100


def test_a_seed_gives_the_same_room_and_light_on_any_number_of_threads():
    first, second = (
        pack_scene(bake_light(lamps_and_some(build_room(7)), 7, threads)) for threads in (1, 2)
    )

    np.testing.assert_array_equal(first.geometry, second.geometry)
    np.testing.assert_array_equal(first.texels, second.texels)


def lamps_and_some(surfaces):
    return [s for i, s in enumerate(surfaces) if s.is_lamp or i % 20 == 6]


def test_a_seed_gives_the_same_bytes(room, lit_scene, room_options, tmp_path):
    again = tmp_path / "again"
    record_scene(again, lit_scene, room_options)

    assert open_sequence(again).frame(7).rgb.bytes == room.frame(7).rgb.bytes
    assert open_sequence(again).frame(7).depth.bytes == room.frame(7).depth.bytes


def test_a_wall_is_at_its_exact_depth():
    texture = np.full((8, 8, 3), 128, np.uint8)
    wall = panel([0.0, 2.0, 0.0], Facing(np.array([0.0, 1.0, 0.0]), UP), (9.0, 9.0), texture)
    camera = look(np.zeros(3), yaw_rad=0.3, pitch_rad=0.0)

    depth_m, cosine = render_depth(pack_scene([wall]), camera, SMALL)

    ahead = depth_m[60, 80]
    slope = (80 - SMALL.cx) / SMALL.fx
    assert ahead == pytest.approx(2.0 / (np.cos(0.3) + slope * np.sin(0.3)), abs=1e-3)
    assert cosine[60, 80] == pytest.approx(np.cos(0.3), abs=0.01)


def test_the_path_is_a_closed_loop_inside_the_room():
    path = np.array(camera_path(400))

    steps = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    closing = np.linalg.norm(path[0, :3, 3] - path[-1, :3, 3])

    assert closing <= steps.max()
    assert steps.max() < 0.03
    assert (path[:, :3, 3] > 0.3).all() and (path[:, :3, 3] < SIZE_M - 0.3).all()


def flat(depth_m: float) -> np.ndarray:
    return np.full((120, 160), depth_m, np.float32)


def measured(exact, cosine=1.0, seed=0):
    camera = SMALL.scaled(4)  # a Kinect's focal length sets its disparities
    rng = np.random.default_rng(seed)
    return measure_depth(exact, np.full_like(exact, cosine), camera, KinectNoise(), rng)


def test_kinect_noise_grows_with_depth_squared():
    near, far = measured(flat(1.0)), measured(flat(3.0))

    assert near.std() < 0.005
    assert 0.005 < far.std() < 0.03
    assert far.mean() == pytest.approx(3.0, abs=0.01)


def test_kinect_depth_comes_in_steps():
    values = np.unique(measured(flat(3.0)))

    assert len(values) < 12


def test_kinect_sees_nothing_beyond_its_range_or_at_grazing_incidence():
    assert not measured(flat(6.0)).any()
    assert not measured(flat(2.0), cosine=0.05).any()


def test_a_near_object_casts_a_shadow_to_its_left():
    exact = flat(3.0)
    exact[:, 80:] = 1.0

    holes = (measured(exact) == 0).mean(axis=0)

    assert holes[65:78].mean() > 0.9
    assert holes[:40].max() < 0.1


@pytest.mark.parametrize("wrong", [{"num_frames": 1}, {"seed": -1}])
def test_impossible_recordings_are_refused(wrong):
    with pytest.raises(ConfigError):
        SynthOptions(**wrong)
