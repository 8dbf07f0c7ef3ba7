"""Single images found in a map that exists, without a session of frames."""

import dataclasses

import numpy as np
import pytest

from services.mapping.keyframes.store import KeyframeStore
from services.tracking.config import TrackingConfig
from services.tracking.localization import localize
from shared.camera import Calibration, Camera
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage
from shared.localization import LocalizationStatus, LocalizeRequest
from shared.se3 import angle_rad, exp, inverse

CONFIG = TrackingConfig()
AWAY = exp([0.2, 0.05, 0.1, 0.02, 0.75, 0.03])  # between the keyframes of `mapped`


def turn(index: int) -> np.ndarray:
    return exp([0.02 * index, 0.0, 0.01 * index, 0.0, 0.1 * index, 0.0])


@pytest.fixture(scope="module")
def mapped(room, new_session) -> KeyframeStore:
    """A map of half the room, by a camera that turned on the spot."""
    session = new_session()
    for i in range(16):
        session.track(room.frame(i, turn(i)))
    assert len(session.store) >= 5
    return session.store


def request(room, T_world_camera: np.ndarray, **changes) -> LocalizeRequest:
    frame = room.frame(0, T_world_camera)
    question = LocalizeRequest("test", 1, 0, room.calibration, frame.rgb, frame.depth)
    return dataclasses.replace(question, **changes)


@pytest.fixture(scope="module")
def found(source_of):
    """A function that asks a map for an image."""
    return lambda store, question: localize(question, source_of(store, CONFIG), CONFIG)


def assert_at(T_world_camera, T_true, limit_m, limit_deg):
    step = inverse(T_true) @ T_world_camera
    assert np.linalg.norm(step[:3, 3]) < limit_m
    assert np.degrees(angle_rad(step)) < limit_deg


def test_an_image_is_found_to_the_millimetre_without_a_prior(mapped, room, found):
    result = found(mapped, request(room, AWAY))

    assert (result.status, result.reason) == (LocalizationStatus.LOCALISED, "")
    assert_at(result.T_world_camera, AWAY, 0.003, 0.1)


def test_the_answer_tells_its_keyframe_revision_and_accuracy(mapped, room, found):
    result = found(mapped, request(room, AWAY))

    assert result.reference_seq in mapped.seqs()
    assert result.map_revision == mapped.revision
    assert 0.0 < np.sqrt(np.trace(result.covariance[:3, :3])) < 0.02


def test_colour_alone_is_found_and_said_to_be_unconfirmed(mapped, room, found):
    result = found(mapped, request(room, AWAY, depth=None))

    assert result.status is LocalizationStatus.COLOUR_ONLY
    assert_at(result.T_world_camera, AWAY, 0.01, 0.3)


def test_another_camera_finds_itself_in_the_map(mapped, room, found):
    wider = dataclasses.replace(room.intrinsics, fx=210.0, fy=210.0)
    other = dataclasses.replace(
        room, intrinsics=wider, calibration=Calibration(Camera(wider), 1000.0)
    )

    result = found(mapped, request(other, AWAY))

    assert result.status is LocalizationStatus.LOCALISED
    assert_at(result.T_world_camera, AWAY, 0.005, 0.2)


def test_a_prior_saves_the_search_and_changes_little(mapped, room, found):
    near = AWAY @ exp([0.03, 0.0, 0.02, 0.0, 0.02, 0.0])

    guided = found(mapped, request(room, AWAY, T_world_prior=near))

    assert guided.status is LocalizationStatus.LOCALISED
    assert_at(guided.T_world_camera, AWAY, 0.003, 0.1)


def test_a_wrong_prior_does_no_harm(mapped, room, found):
    wrong = exp([1.0, 0.3, -1.0, 0.0, 3.0, 0.0])

    misled = found(mapped, request(room, AWAY, T_world_prior=wrong))

    assert_at(misled.T_world_camera, AWAY, 0.003, 0.1)


def test_the_same_image_gives_the_same_bits(mapped, room, found):
    a, b = (found(mapped, request(room, AWAY)) for _ in range(2))

    np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
    np.testing.assert_array_equal(a.covariance, b.covariance)


def test_a_map_from_a_snapshot_answers_the_same(mapped, room, found):
    restored = KeyframeStore.from_state(mapped.state())

    a, b = found(mapped, request(room, AWAY)), found(restored, request(room, AWAY))

    np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


def test_the_unmapped_side_of_the_room_is_refused(mapped, room, found):
    result = found(mapped, request(room, exp([0.0, 0.0, 0.0, 0.0, -2.2, 0.0])))

    assert result.status is LocalizationStatus.NOT_LOCALISED
    assert result.reason == "no keyframe looks like this"


def test_the_same_picture_at_another_depth_is_refuted(mapped, room, found):
    frame = room.frame(0, AWAY)
    raw = np.frombuffer(frame.depth.bytes, "<u2")
    halved = dataclasses.replace(frame.depth, bytes=(raw // 2).astype("<u2").tobytes())

    result = found(mapped, request(room, AWAY, depth=halved))

    assert result.status is LocalizationStatus.NOT_LOCALISED
    assert "does not confirm it" in result.reason


def test_a_black_image_is_refused_for_its_texture(mapped, room, found):
    black = ColourImage(
        ColourEncoding.RGB8, bytes(3 * room.intrinsics.width * room.intrinsics.height)
    )

    result = found(mapped, request(room, AWAY, rgb=black))

    assert result.status is LocalizationStatus.NOT_LOCALISED
    assert "too little texture: 0 features" in result.reason


def test_an_empty_map_says_so(room, found):
    result = found(KeyframeStore(), request(room, AWAY))

    assert result.reason == "the map has no keyframes yet"


def test_a_damaged_image_is_refused_by_name(mapped, room, found):
    cut = ColourImage(ColourEncoding.JPEG, b"\xff\xd8\xff")

    with pytest.raises(InputError, match="rgb.bytes"):
        found(mapped, request(room, AWAY, rgb=cut))


def test_a_session_without_a_prior_joins_the_map_by_relocalising(mapped, room, new_session):
    session = new_session(store=KeyframeStore.from_state(mapped.state()))

    result = session.answer(room.frame(100, AWAY))

    assert result.status == "RELOCALISED"
    assert_at(result.T_world_camera, AWAY, 0.003, 0.1)
