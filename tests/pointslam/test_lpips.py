"""LPIPS with random weights: laws, and a twin of plain torch operations."""

from __future__ import annotations

import numpy as np
import pytest
import safetensors.numpy
import torch
from torch.nn import functional

from pointslam.evaluation.lpips import Lpips
from shared.errors import ConfigError

# (stage, layer, out, in, size) of each convolution, and what is pooled before each stage.
LAYERS = {
    "alex": [
        *((1, 0, 64, 3, 11), (2, 3, 192, 64, 5), (3, 6, 384, 192, 3)),
        *((4, 8, 256, 384, 3), (5, 10, 256, 256, 3)),
    ],
    "vgg": [
        *((1, 0, 64, 3, 3), (1, 2, 64, 64, 3), (2, 5, 128, 64, 3), (2, 7, 128, 128, 3)),
        *((3, 10, 256, 128, 3), (3, 12, 256, 256, 3), (3, 14, 256, 256, 3)),
        *((4, 17, 512, 256, 3), (4, 19, 512, 512, 3), (4, 21, 512, 512, 3)),
        *((5, 24, 512, 512, 3), (5, 26, 512, 512, 3), (5, 28, 512, 512, 3)),
    ],
}
POOLS = {"alex": {2: 3, 3: 3}, "vgg": {2: 2, 3: 2, 4: 2, 5: 2}}


@pytest.fixture(scope="module", params=["alex", "vgg"])
def network(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def weights(network) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    found = {}
    for stage, layer, out, channels, size in LAYERS[network]:
        sigma = np.sqrt(2.0 / (channels * size * size))
        shape = (out, channels, size, size)
        found[f"net.slice{stage}.{layer}.weight"] = rng.normal(0, sigma, shape)
        found[f"net.slice{stage}.{layer}.bias"] = rng.normal(0, 0.1, out)
        found[f"lin{stage - 1}.model.1.weight"] = rng.uniform(0, 0.2, (1, out, 1, 1))
    return {name: array.astype(np.float32) for name, array in found.items()}


@pytest.fixture
def pictures() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    first = rng.integers(0, 256, (67, 90, 3)).astype(np.uint8)
    return first, np.roll(first, 2, axis=1)


def twin(weights, network, first, second) -> float:
    """LPIPS by torch's own convolutions and pools."""
    named = {name: torch.from_numpy(array) for name, array in weights.items()}
    images = torch.from_numpy(np.stack([first, second])).permute(0, 3, 1, 2).float() / 127.5 - 1
    shift = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
    features = (images - shift) / torch.tensor([0.458, 0.448, 0.450])[:, None, None]
    layers, total = LAYERS[network], 0.0
    for number, (stage, layer, _, _, size) in enumerate(layers):
        name = f"net.slice{stage}.{layer}"
        if stage in POOLS[network] and (stage != layers[number - 1][0]):
            features = functional.max_pool2d(features, POOLS[network][stage], 2)
        options = {"stride": 4, "padding": 2} if size == 11 else {"padding": size // 2}
        features = functional.conv2d(
            features, named[f"{name}.weight"], named[f"{name}.bias"], **options
        ).relu()
        if number + 1 == len(layers) or layers[number + 1][0] != stage:
            unit = features / (features.norm(dim=1, keepdim=True) + 1e-10)
            head = named[f"lin{stage - 1}.model.1.weight"].flatten()
            total += float(((unit[0] - unit[1]) ** 2 * head[:, None, None]).sum(0).mean())
    return total


def test_a_picture_is_no_distance_from_itself(weights, pictures):
    assert Lpips(weights)(pictures[0], pictures[0]) == 0.0


def test_the_distance_is_the_same_both_ways(weights, pictures):
    distance = Lpips(weights)

    assert distance(*pictures) == pytest.approx(distance(*pictures[::-1]), rel=1e-6)


def test_the_distance_is_that_of_plain_torch_operations(weights, network, pictures):
    found = Lpips(weights)(*pictures)

    assert found == pytest.approx(twin(weights, network, *pictures), rel=1e-4)


def test_the_network_is_told_by_its_weights_in_a_file(weights, network, tmp_path):
    safetensors.numpy.save_file(weights, tmp_path / "lpips.safetensors")

    assert Lpips.read(tmp_path / "lpips.safetensors").network == network


def test_the_names_of_the_packages_list_of_heads_are_understood(weights, pictures):
    renamed = {
        name.replace("lin", "lins.", 1) if name.startswith("lin") else name: array
        for name, array in weights.items()
    }

    assert Lpips(renamed)(*pictures) == Lpips(weights)(*pictures)


def test_weights_of_another_network_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="neither AlexNet's"):
        Lpips({"net.slice1.0.weight": np.zeros((8, 3, 3, 3), np.float32)})


def test_a_missing_weight_is_named(weights):
    with pytest.raises(ConfigError, match=r"lin0\.model\.1\.weight is absent"):
        Lpips({name: w for name, w in weights.items() if not name.startswith("lin0")})


def test_a_file_that_is_no_safetensors_is_refused(tmp_path):
    (tmp_path / "weights.pth").write_bytes(b"\x80\x02 a pickle")

    with pytest.raises(ConfigError, match="no safetensors file"):
        Lpips.read(tmp_path / "weights.pth")
