"""What it takes to believe an estimate: less where the camera was expected, more elsewhere."""

import dataclasses

import numpy as np
import pytest

from services.tracking.belief import is_coarse, is_confirmed
from services.tracking.config import TrackingConfig
from services.tracking.estimate import Estimate, attempt
from services.tracking.executors import NoHelper
from services.tracking.local_map import derive
from services.tracking.observed import EncodedImages, observe
from services.tracking.stopwatch import Stopwatch
from shared.se3 import exp

CONFIG = TrackingConfig()
HERE, AWAY = np.eye(4), exp([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def sure(room, new_session) -> Estimate:
    """An estimate with hundreds of features, all of whose surface is in the map."""
    session = new_session()
    session.track(room.frame(0, HERE))
    local = derive(session.store.context(0), CONFIG.registration)
    frame = room.frame(1, HERE)
    images = EncodedImages(frame.rgb, frame.depth, room.calibration)
    observed = observe(images, CONFIG, Stopwatch(), NoHelper())
    return attempt(observed, local, HERE, CONFIG, Stopwatch())


def doubted(sure: Estimate, features: int, agreement: float, overlap: float = 1.0) -> Estimate:
    """The same with so many features, so much depth that agrees and surface that is known."""
    return dataclasses.replace(
        sure,
        matches=sure.matches.where(np.arange(len(sure.matches)) < features),
        num_matches=features,
        agreement=dataclasses.replace(sure.agreement, share=agreement),
        registration=dataclasses.replace(sure.registration, overlap=overlap),
    )


@pytest.mark.parametrize(
    ("features", "agreement", "T_predicted", "expected"),
    [
        (30, 0.95, AWAY, True),
        (30, 0.80, AWAY, False),
        (30, 0.80, HERE, True),
        (200, 0.80, AWAY, True),
        (200, 0.50, HERE, False),
        (10, 1.00, HERE, False),
    ],
)
def test_few_features_away_from_the_prediction_need_depth_that_agrees(
    sure, features, agreement, T_predicted, expected
):
    estimate = doubted(sure, features, agreement)

    assert is_confirmed(estimate, T_predicted, CONFIG.verification) == expected


@pytest.mark.parametrize(
    ("overlap", "T_predicted", "expected"),
    [(0.4, AWAY, True), (0.15, AWAY, False), (0.15, HERE, True), (0.05, HERE, False)],
)
def test_geometry_alone_needs_more_of_the_map_away_from_the_prediction(
    sure, overlap, T_predicted, expected
):
    estimate = doubted(sure, features=0, agreement=1.0, overlap=overlap)

    assert is_coarse(estimate, T_predicted, CONFIG.verification) == expected
