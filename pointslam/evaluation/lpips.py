"""LPIPS (Zhang et al. 2018), AlexNet or VGG16, in numpy: no torch beside the client.

The weights are the user's own, one safetensors file with the names of the package `lpips`:

    safetensors.torch.save_model(lpips.LPIPS(net="alex"), "lpips-alex.safetensors")
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.errors import ConfigError

Images = NDArray[np.float32]  # [N, C, H, W]

# Inputs lie in -1 to 1; the networks were trained on ImageNet's mean and deviation.
_SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)[:, None, None]
_SCALE = np.array([0.458, 0.448, 0.450], np.float32)[:, None, None]
_EPSILON = 1e-10
_ROWS = 1 << 16  # output pixels of one matrix product: bounds the memory of unfolded patches


@dataclass(frozen=True)
class Convolution:
    """A convolution with a ReLU behind it."""

    weight: NDArray[np.float32]  # [out, in, k, k]
    bias: NDArray[np.float32]  # [out]
    stride: int = 1

    def __call__(self, images: Images) -> Images:
        """Filtered images; half a kernel of zeros around, AlexNet's first one as trained (2)."""
        out, channels, size, _ = self.weight.shape
        pad = min(size // 2, 2)
        padded = np.pad(images, ((0, 0), (0, 0), (pad, pad), (pad, pad)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), (2, 3))
        windows = windows[:, :, :: self.stride, :: self.stride]
        count, _, height, width = windows.shape[:4]
        matrix = self.weight.reshape(out, channels * size * size).T
        result = np.empty((count, height, width, out), np.float32)
        rows = max(1, _ROWS // width)
        for image, top in np.ndindex(count, -(-height // rows)):
            part = slice(top * rows, (top + 1) * rows)
            patches = windows[image, :, part].transpose(1, 2, 0, 3, 4)
            patches = patches.reshape(-1, channels * size * size)
            result[image, part] = (patches @ matrix + self.bias).reshape(-1, width, out)
        return np.maximum(result, 0.0).transpose(0, 3, 1, 2)


@dataclass(frozen=True)
class _Stage:
    """Layers up to the next features that are compared."""

    pool: int  # side of the maximum filter before them, stride 2; 0: none
    layers: tuple[int, ...]  # numbers of the convolutions, as torchvision counts them


_NETWORKS: dict[str, tuple[_Stage, ...]] = {
    "alex": (
        _Stage(0, (0,)),
        _Stage(3, (3,)),
        _Stage(3, (6,)),
        _Stage(0, (8,)),
        _Stage(0, (10,)),
    ),
    "vgg": (
        _Stage(0, (0, 2)),
        _Stage(2, (5, 7)),
        _Stage(2, (10, 12, 14)),
        _Stage(2, (17, 19, 21)),
        _Stage(2, (24, 26, 28)),
    ),
}


class Lpips:
    """The perceptual distance of two pictures: 0 for equal ones; about 0.1 is hard to see."""

    def __init__(self, weights: Mapping[str, NDArray[np.float32]]) -> None:
        """Networks of named weights.

        Raises:
            ConfigError: they are neither AlexNet's nor VGG16's.
        """
        self.network = _network_of(weights)
        self._stages = _NETWORKS[self.network]
        self._convolutions = {
            layer: _convolution(weights, stage_number, layer)
            for stage_number, stage in enumerate(self._stages, 1)
            for layer in stage.layers
        }
        self._heads = [_head(weights, number) for number in range(len(self._stages))]

    @classmethod
    def read(cls, path: Path) -> Lpips:
        """The networks of a safetensors file.

        Raises:
            ConfigError: the file cannot be read, or its weights are of no such network.
        """
        try:
            from safetensors import SafetensorError
            from safetensors.numpy import load_file
        except ImportError:
            raise ConfigError("LPIPS needs safetensors (pip install 'pointslam[eval]')") from None
        try:
            return cls(load_file(path))
        except (OSError, SafetensorError) as error:
            raise ConfigError(f"{path}: no safetensors file ({error})") from None

    def __call__(self, rendered: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
        """The distance of two pictures, [H, W, 3]; without unit, 0 and up."""
        pair = np.stack([rendered, truth]).transpose(0, 3, 1, 2).astype(np.float32)
        features = (pair / np.float32(127.5) - 1.0 - _SHIFT) / _SCALE
        total = 0.0
        for stage, head in zip(self._stages, self._heads, strict=True):
            if stage.pool:
                features = maximum_pool(features, stage.pool)
            for layer in stage.layers:
                features = self._convolutions[layer](features)
            unit = features / (np.linalg.norm(features, axis=1, keepdims=True) + _EPSILON)
            squared = (unit[0] - unit[1]) ** 2
            total += float(np.tensordot(head, squared, 1).mean(dtype=np.float64))
        return total


def maximum_pool(images: Images, size: int) -> Images:
    """The largest value of every `size` x `size` window that fits, at stride 2."""
    height, width = ((side - size) // 2 + 1 for side in images.shape[2:])
    flat = images.reshape(-1, *images.shape[2:])
    kernel = np.ones((size, size), np.uint8)
    highest = np.stack([cv2.dilate(plane, kernel, anchor=(0, 0)) for plane in flat])
    pooled = highest[:, : 2 * height : 2, : 2 * width : 2]
    return pooled.reshape(*images.shape[:2], height, width).astype(np.float32, copy=False)


def _network_of(weights: Mapping[str, NDArray]) -> str:
    first = weights.get("net.slice1.0.weight")
    for name, size in (("alex", 11), ("vgg", 3)):
        if first is not None and first.shape == (64, 3, size, size):
            return name
    raise ConfigError(
        "LPIPS weights: net.slice1.0.weight is neither AlexNet's [64, 3, 11, 11] nor VGG16's "
        f"[64, 3, 3, 3] but {'absent' if first is None else list(first.shape)}"
    )


def _convolution(weights: Mapping[str, NDArray], stage: int, layer: int) -> Convolution:
    weight = _weight(weights, f"net.slice{stage}.{layer}.weight")
    bias = _weight(weights, f"net.slice{stage}.{layer}.bias")
    return Convolution(weight, bias, stride=4 if weight.shape[2] == 11 else 1)


def _head(weights: Mapping[str, NDArray], number: int) -> NDArray[np.float32]:
    """Weights of a stage's channels, [C]; the package names them twice."""
    pattern = re.compile(rf"(lin{number}|lins\.{number})\.model\.\d+\.weight")
    name = next(filter(pattern.fullmatch, weights), f"lin{number}.model.1.weight")
    return _weight(weights, name).reshape(-1)


def _weight(weights: Mapping[str, NDArray], name: str) -> NDArray[np.float32]:
    if name not in weights:
        raise ConfigError(f"LPIPS weights: {name} is absent")
    return np.asarray(weights[name], np.float32)
