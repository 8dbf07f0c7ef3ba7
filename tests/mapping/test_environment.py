"""What the features of new anchors start with: colours, or the paper's Eq. 7."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from services.mapping.anchors.anchor_map import AnchorMap, NewAnchors
from services.mapping.config import AnchorConfig, LearningRates, MappingConfig
from services.mapping.decoding.decoder import VisibleAnchors
from services.mapping.decoding.decoders import NeuralDecoder
from services.mapping.decoding.environment import Environment

CPU = torch.device("cpu")
CENTRE = np.array([0.0, 0.0, -2.0])
COUNT = 50


def config(features: str) -> MappingConfig:
    return MappingConfig(anchors=AnchorConfig(features=features))


@pytest.fixture
def seeded():
    """A map of one anchor per colour, all of whose children have it, as seeding makes it."""

    def make(features: str) -> tuple[AnchorMap, np.ndarray]:
        rng = np.random.default_rng(0)
        colours = rng.uniform(0.1, 0.9, (COUNT, 3)).astype(np.float32)
        first = np.zeros((COUNT, 32), np.float32)
        first[:, :15] = np.tile(np.log(colours / (1 - colours)), 5)
        anchors = AnchorMap(AnchorConfig(features=features), CPU)
        new = NewAnchors(
            positions=rng.normal(0, 0.5, (COUNT, 3)).astype(np.float32),
            features=first,
            offsets=np.zeros((COUNT, 15), np.float32),
            scalings=np.full((COUNT, 6), -4, np.float32),
            keys=np.arange(COUNT),
            is_primary=np.zeros(COUNT, bool),
        )
        anchors.append(new, creator_seq=0)
        return anchors, colours

    return make


@pytest.mark.parametrize("features", ["colours", "environment", "both"])
def test_an_untrained_map_shows_the_colours_of_its_keyframe(seeded, features):
    anchors, colours = seeded(features)
    decoder = NeuralDecoder(config(features), 0, CPU)
    camera = torch.from_numpy(CENTRE).float()

    Environment(config(features), 0, CPU).initialise(anchors, COUNT, CENTRE)

    shown = decoder.decode(anchors, torch.arange(COUNT), camera)[1].colours.view(COUNT, 5, 3)
    assert np.abs(shown.detach().numpy() - colours[:, None]).mean() < 0.06


def test_random_features_know_no_colours(seeded):
    anchors, colours = seeded("random")

    Environment(config("random"), 0, CPU).initialise(anchors, COUNT, CENTRE)

    shown = anchors.rows["features"][:, :3].sigmoid().numpy()
    assert np.abs(np.corrcoef(shown[:, 0], colours[:, 0])[0, 1]) < 0.4
    assert shown.std() < 0.1


def test_only_the_newest_anchors_are_given_features(seeded):
    anchors, _ = seeded("environment")
    before = anchors.rows["features"].clone()

    Environment(config("environment"), 0, CPU).initialise(anchors, 10, CENTRE)

    assert torch.equal(anchors.rows["features"][:40], before[:40])
    assert (anchors.rows["features"][40:] != before[40:]).any(1).all()


def test_the_embedding_depends_on_the_direction_an_anchor_is_seen_in(seeded):
    environment = Environment(config("environment"), 0, CPU)
    features = []
    for centre in (CENTRE, -CENTRE):
        anchors, _ = seeded("environment")
        environment.initialise(anchors, COUNT, centre)
        features.append(anchors.rows["features"].clone())

    assert (features[0] - features[1]).abs().mean() > 0.01


def embedded(environment: Environment, seeded) -> torch.Tensor:
    anchors, _ = seeded("environment")
    environment.initialise(anchors, COUNT, CENTRE)
    return anchors.rows["features"].clone()


@pytest.fixture
def learn(seeded):
    """One step towards smaller features, by anchors of so many steps of Adam."""

    def run(environment: Environment, steps: int) -> None:
        anchors, _ = seeded("environment")
        environment.initialise(anchors, COUNT, CENTRE)
        anchors.rows["steps"][:] = steps
        decoder = NeuralDecoder(config("environment"), 0, CPU)
        camera = torch.from_numpy(CENTRE).float()
        visible, _ = decoder.decode(anchors, torch.arange(COUNT), camera, is_trained=True)
        assert isinstance(visible, VisibleAnchors)
        visible.features.grad = visible.features.detach().clone()
        environment.step(anchors, visible, LearningRates())

    return run


def test_the_embedding_learns_from_the_gradients_at_young_anchors(seeded, learn):
    environment = Environment(config("environment"), 0, CPU)
    before = embedded(environment, seeded)

    for _ in range(20):
        learn(environment, steps=3)

    assert embedded(environment, seeded).abs().mean() < 0.8 * before.abs().mean()


def test_old_anchors_leave_the_embedding_alone(seeded, learn):
    environment = Environment(config("environment"), 0, CPU)
    before = embedded(environment, seeded)

    learn(environment, steps=1000)

    assert torch.equal(embedded(environment, seeded), before)


def test_an_environment_goes_on_from_its_state(seeded, learn):
    first, second = (Environment(config("environment"), seed, CPU) for seed in (0, 1))
    learn(first, steps=3)

    second.restore(first.state())
    for environment in (first, second):
        learn(environment, steps=3)

    assert torch.equal(embedded(first, seeded), embedded(second, seeded))
