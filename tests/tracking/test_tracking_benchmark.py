"""The tracking benchmark: peers that are there or said to be absent, variants, a cold worker."""

import numpy as np
import pytest

from benchmarks import tracking_variants
from benchmarks.cold_worker import cold_worker
from benchmarks.peers.opencv_odometry import OpencvOdometry
from benchmarks.peers.registry import PEERS, PeerEntry
from benchmarks.tracking_run import absolute_error
from benchmarks.truth import grey_residual, register_pair
from services.tracking.config import SurfaceConfig, TrackingConfig
from services.tracking.point_cloud import surface_from_depth
from shared.config import override, read_overrides
from shared.se3 import exp


def step(index: int) -> np.ndarray:
    return exp([0.01 * index, 0.0, 0.005 * index, 0.0, 0.01 * index, 0.0])


CORNER = exp([0.0, 0.0, 0.0, 0.5, 0.65, 0.0])  # three walls: geometry alone holds the pose


def test_a_peer_finds_the_motion_of_the_room(room):
    peer = OpencvOdometry()

    poses = [peer.track(room.view(CORNER @ step(i))) for i in range(4)]

    assert all(pose.is_tracked for pose in poses)
    np.testing.assert_allclose(poses[-1].T_world_camera, step(3), atol=0.01)


@pytest.mark.parametrize("entry", [p for p in PEERS if p.library != "cv2"], ids=lambda p: p.name)
def test_an_optional_peer_finds_the_motion_where_its_library_is(entry, room):
    pytest.importorskip(entry.library)
    peer = entry.make()

    poses = [peer.track(room.view(CORNER @ step(i))) for i in range(4)]

    np.testing.assert_allclose(poses[-1].T_world_camera, step(3), atol=0.05)


def test_an_absent_peer_is_said_to_be_absent(monkeypatch):
    absent = PeerEntry("another tracker", "no_such_library", "benchmarks.peers.none", "None")
    monkeypatch.setattr(tracking_variants, "PEERS", (absent,))

    (row,) = tracking_variants.peers(sequence=None, indices=[])  # pyright: ignore

    assert row.absent == "no_such_library is not installed"


@pytest.mark.parametrize("settings", tracking_variants.ABLATION.values())
def test_every_variant_is_made_of_settings_that_exist(settings):
    changed = override(TrackingConfig(), read_overrides(None, list(settings)))

    assert (changed == TrackingConfig()) == (not settings)


def test_without_bundle_adjustment_keyframes_stay_where_they_were_tracked(new_session, room):
    config = override(TrackingConfig(), read_overrides(None, ["bundle_adjustment.iterations=0"]))
    session = new_session(config=config)

    first = session.track(room.frame(0, step(0)))
    session.track(room.frame(20, step(20)))

    np.testing.assert_array_equal(session.store.pose(0), first.T_world_camera)


def test_a_cold_worker_costs_building_sending_and_deriving(new_session, room):
    session = new_session()
    session.track(room.frame(0, step(0)))

    cost = cold_worker(session.store, TrackingConfig())

    assert min(cost.build_ms, cost.wire_ms, cost.derive_ms, cost.context_kb) > 0.0


def test_two_poses_have_no_absolute_error():
    poses = np.stack([step(0), step(1)])

    assert np.isnan(absolute_error(poses, poses))


def test_a_truth_that_is_off_is_told_from_a_pose_that_is_right(room):
    T = np.linalg.inv(CORNER) @ (CORNER @ step(5))
    earlier, later = (
        surface_from_depth(view.depth_m, view.intrinsics, SurfaceConfig(stride_px=2))
        for view in (room.view(CORNER), room.view(CORNER @ step(5)))
    )
    off = T @ exp([0.02, 0.0, 0.01, 0.0, 0.0, 0.01])

    pair = register_pair(earlier, later, off, T)

    np.testing.assert_allclose(pair.from_true, T, atol=1e-3)
    np.testing.assert_allclose(pair.from_tracked, T, atol=1e-3)
    assert pair.residuals_mm[0] > 3.0 * max(pair.residuals_mm[1:])


def test_two_images_agree_under_their_true_motion_and_under_no_other(room):
    earlier, later = (room.view(CORNER @ step(i)) for i in (0, 3))

    assert grey_residual(earlier, later, step(3)) < 0.5 * grey_residual(earlier, later, step(0))
