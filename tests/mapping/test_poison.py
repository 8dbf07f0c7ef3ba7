"""What no parameter of the map may learn from: faults of sensors, trackers and arithmetic."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from services.mapping.config import AnchorConfig, DensificationConfig, MappingConfig
from services.mapping.decoding.optimizer import adam_rows, adam_rows_torch, begin_step
from services.mapping.pipeline import Mapper, NewKeyframe
from services.mapping.storage.entries import check_entry
from shared import se3
from shared.errors import InputError
from shared.frames import DepthEncoding
from shared.images import encode_depth, encode_jpeg
from shared.maps import RenderRequest
from shared.tracks import KeyframeLink, KeyframePoses, LoopConstraint

SHAPE = 72, 96


@pytest.fixture
def mapper(calibration, frame, true_pose) -> Mapper:
    mapper = Mapper(calibration, MappingConfig(), 0, torch.device("cpu"))
    mapper.insert_keyframe(new_keyframe(frame(0), {0: true_pose(0)}))
    mapper.iterate(40)
    return mapper


def new_keyframe(frame, poses: dict[int, np.ndarray], landmarks=None) -> NewKeyframe:
    known = KeyframePoses(len(poses), np.array(list(poses)), np.stack(list(poses.values())))
    return NewKeyframe(frame, known, np.zeros((0, 3)) if landmarks is None else landmarks)


def spiked(frame):
    """A quarter of the depth pixels read 60 m."""
    raw = np.frombuffer(frame.depth.bytes, np.uint16).reshape(SHAPE).copy()
    raw[::2, ::2] = 60_000
    return replace(frame, depth=encode_depth(raw, DepthEncoding.RAW16))


def flat(value: int):
    """A frame of one colour."""
    return lambda frame: replace(frame, rgb=encode_jpeg(np.full((*SHAPE, 3), value, np.uint8)))


def not_finite(mapper: Mapper) -> list[str]:
    tensors = mapper.state().tensors
    return [name for name, t in tensors.items() if t.is_floating_point() and not t.isfinite().all()]


@pytest.mark.parametrize(
    "poison", [spiked, flat(0), flat(255)], ids=["60 m spikes", "all black", "saturated"]
)
def test_the_map_survives_a_poisoned_frame(mapper, frame, true_pose, calibration, poison):
    poses = {seq: true_pose(seq) for seq in (0, 4, 8)}
    mapper.insert_keyframe(new_keyframe(poison(frame(4)), {0: poses[0], 4: poses[4]}))
    mapper.iterate(40)
    mapper.insert_keyframe(new_keyframe(frame(8), poses))
    mapper.iterate(40)

    view = mapper.render(RenderRequest(true_pose(8), calibration.colour.intrinsics))

    assert not_finite(mapper) == []
    assert (view.alpha > 200).mean() > 0.8


def test_landmarks_that_are_no_numbers_make_no_anchor(mapper, frame, true_pose):
    landmarks = np.full((5, 3), np.nan)
    poses = {seq: true_pose(seq) for seq in (0, 4)}

    mapper.insert_keyframe(new_keyframe(frame(4), poses, landmarks))

    assert not_finite(mapper) == []


def test_memory_is_flat_once_the_cap_on_anchors_is_reached(calibration, frame, true_pose):
    growing = DensificationConfig(
        first_iteration=1, grow_interval=2, cull_interval=10, grow_share=0.5, min_visits=1
    )
    config = MappingConfig(anchors=AnchorConfig(max_anchors=900), densification=growing)
    mapper = Mapper(calibration, config, 0, torch.device("cpu"))
    mapper.insert_keyframe(new_keyframe(frame(0), {0: true_pose(0)}))
    mapper.iterate(50)
    before = resident_mb()

    mapper.iterate(300)

    assert len(mapper.anchors) == 900
    assert resident_mb() - before < 10.0


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.parametrize("step_rows", [adam_rows, adam_rows_torch], ids=["cpu", "torch"])
@pytest.mark.parametrize("fault", [np.nan, np.inf, -np.inf, 1e30])
def test_a_slope_that_is_no_number_counts_as_none(mapper, fault, step_rows):
    rows = mapper.anchors.rows
    slope = torch.full((2, rows["features"].shape[1]), fault)
    rows["features_mean"].zero_()
    before = rows["features"][:2].clone()

    step_rows(begin_step(rows, torch.arange(2)), "features", slope, 0.1)

    assert torch.equal(rows["features"][:2], before)
    assert not_finite(mapper) == []


@pytest.mark.parametrize(
    "T",
    [np.full((4, 4), 1e30), np.diag([1e6, 1e6, 1e6, 1.0]), np.diag([1.0, 1.0, -1.0, 1.0])],
    ids=["huge", "scaled", "mirrored"],
)
def test_a_pose_that_is_no_motion_is_refused(entry, T):
    good = entry(4)

    with pytest.raises(InputError, match="T_world_camera"):
        check_entry(replace(good, record=replace(good.record, T_world_camera=T)))


def test_a_camera_beyond_the_horizon_is_refused(entry):
    good = entry(4)
    far = se3.exp([2e4, 0, 0, 0, 0, 0])

    with pytest.raises(InputError, match="10000 m"):
        check_entry(replace(good, record=replace(good.record, T_world_camera=far)))


def test_a_link_without_six_by_six_numbers_is_refused(entry):
    good = entry(4)
    bad = replace(good.keyframe, link=KeyframeLink(0, 1, np.eye(3)))

    with pytest.raises(InputError, match=r"keyframe\.link\.information"):
        check_entry(replace(good, keyframe=bad))


def test_a_loop_with_single_landmarks_is_refused(entry):
    good = entry(4)
    loop = LoopConstraint(0, np.eye(4), np.eye(6), np.arange(6))

    with pytest.raises(InputError, match=r"keyframe\.loop\.landmark_ids"):
        check_entry(replace(good, keyframe=replace(good.keyframe, loop=loop)))


def test_landmarks_of_a_correction_must_be_finite(entry):
    good = entry(4)
    moved = good.keyframe.correction
    positions = np.full_like(moved.positions_world, np.nan)
    bad = replace(good.keyframe, correction=replace(moved, positions_world=positions))

    with pytest.raises(InputError, match="positions_world"):
        check_entry(replace(good, keyframe=bad))
