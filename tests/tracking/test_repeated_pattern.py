"""Features that agree with a place one period away do not outweigh the surfaces missing there."""

import dataclasses

import numpy as np
import pytest

from services.tracking.config import TrackingConfig
from services.tracking.executors import NoHelper
from services.tracking.local_map import LocalMap
from services.tracking.observed import EncodedImages, observe
from services.tracking.search import Job, search
from services.tracking.stopwatch import Stopwatch
from shared.frames import Prior
from shared.se3 import exp, inverse
from shared.tracks import Landmarks, TrackingContext

PERIOD_M = 0.8
LARGE_STEP = exp([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])


def with_pattern(context: TrackingContext, share: float) -> TrackingContext:
    """A context in which a share of the landmarks is known one period further along the wall."""
    landmarks = context.landmarks
    is_away = np.random.default_rng(3).random(len(landmarks.ids)) < share
    moved = landmarks.positions_world + is_away[:, None] * [PERIOD_M, 0.0, 0.0]
    fields = {f.name: getattr(landmarks, f.name) for f in dataclasses.fields(landmarks)}
    repeated = Landmarks(**{**fields, "positions_world": moved})
    return dataclasses.replace(context, landmarks=repeated)


@pytest.fixture
def found(room, session, source_of):
    """The search in a wall of which most features are known one period away."""
    session.track(room.frame(0, np.eye(4)))
    config = TrackingConfig()
    local = LocalMap(with_pattern(session.store.context(0), 0.55), config.registration).built()
    frame = room.frame(1, np.eye(4))
    images = EncodedImages(frame.rgb, frame.depth, room.calibration)
    observed = observe(images, config, Stopwatch(), NoHelper())
    before = Prior(0, 0, inverse(LARGE_STEP), LARGE_STEP, 33_000_000, 0, 0, 0, 1)
    request = dataclasses.replace(session.request(frame), prior=before)
    source = source_of(session.store, config)
    return search(Job(request, observed, source, config, Stopwatch()), local)


def test_the_place_that_explains_the_frame_is_found_though_another_has_more_features(found):
    assert np.linalg.norm(found.estimate.T_world_camera[:3, 3]) < 0.01
