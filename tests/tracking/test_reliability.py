"""A short bad day: repeats, losses, black depth, another place. The long one is a benchmark."""

import dataclasses

import numpy as np
import pytest

from benchmarks.disturbances import Plan, disturbed, to_and_fro
from benchmarks.reliability import Answered, run
from services.tracking.config import TrackingConfig
from shared.camera import Calibration
from shared.frames import HAS_POSE, ColourEncoding, ColourImage, Frame, TrackingStatus
from shared.se3 import exp

CORNER = exp([0.0, 0.0, 0.0, 0.4, 0.8, 0.0])
STEP = np.array([0.02, -0.005, 0.015, 0.004, 0.012, -0.003])
PLAN = Plan(frames=130, away_from=75, away_for=20, seed=3)
RETURN = PLAN.away_from + PLAN.away_for


class RoomSequence:
    """A walk through the room, as a sequence folder would hold it."""

    def __init__(self, room, start: np.ndarray) -> None:
        self.calibration: Calibration = room.calibration
        self._room = room
        self._start = start

    def __len__(self) -> int:
        return 30

    def true_pose(self, index: int) -> np.ndarray:
        return self._start @ exp(index * STEP)

    def frame(self, index: int) -> Frame:
        return self._room.frame(index, self.true_pose(index))


class UpsideDown(RoomSequence):
    """Another place: the colours of no wall of the room."""

    def frame(self, index: int) -> Frame:
        frame = super().frame(index)
        rgb = 255 - np.frombuffer(frame.rgb.bytes, np.uint8)[::-1]
        return dataclasses.replace(frame, rgb=ColourImage(ColourEncoding.RGB8, rgb.tobytes()))


@pytest.fixture(scope="module")
def answers(room) -> list[Answered]:
    return run(RoomSequence(room, CORNER), UpsideDown(room, np.eye(4)), PLAN, TrackingConfig())


def test_the_plan_repeats_drops_and_leaves(room):
    sent = list(disturbed(RoomSequence(room, CORNER), UpsideDown(room, np.eye(4)), PLAN))

    seqs = [s.frame.seq for s in sent]
    assert 49 not in seqs and len(seqs) == PLAN.frames - 2
    assert sent[6].is_repeat and sent[6].frame.digest() == sent[5].frame.digest()
    assert [s.frame.seq for s in sent if s.index is None] == list(range(PLAN.away_from, RETURN))


def test_a_sequence_is_played_to_and_fro():
    assert [to_and_fro(step, 4) for step in range(8)] == [0, 1, 2, 3, 2, 1, 0, 1]


def test_no_wrong_pose_is_believed_on_a_bad_day(answers):
    assert [a.sent.frame.seq for a in answers if a.is_wrong] == []


def test_every_frame_in_the_place_has_a_pose_until_the_camera_leaves(answers):
    before = [a.result for a in answers if a.sent.frame.seq < PLAN.away_from]

    assert [r.seq for r in before if r.status not in HAS_POSE] == []


def test_in_another_place_the_camera_is_lost_and_the_map_is_left_alone(answers):
    away = [a.result for a in answers if a.sent.index is None]

    assert {r.status for r in away} == {TrackingStatus.LOST}
    assert all(r.keyframe is None for r in away)


def test_within_ten_frames_after_the_return_the_camera_is_found(answers):
    returned = [a.result.status for a in answers if a.sent.frame.seq >= RETURN]

    assert any(status in HAS_POSE for status in returned[:10])


def test_no_repeat_is_a_keyframe(answers):
    assert all(a.result.keyframe is None for a in answers if a.sent.is_repeat)
