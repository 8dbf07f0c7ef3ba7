"""One iteration of the mapper on a given scene: decode, render, compare, differentiate, step."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from services.mapping.anchors.anchor_map import FEATURES, AnchorMap, NewAnchors, trained_widths
from services.mapping.config import AnchorConfig, MappingConfig
from services.mapping.decoding.decoders import NeuralDecoder
from services.mapping.decoding.optimizer import adam_rows, begin_step
from services.mapping.losses.cpu import mapping_loss_cpu
from services.mapping.losses.mapping_loss import Appearance, Target, mapping_loss
from services.mapping.rasterizer import Gaussians, Rasterizer, View
from services.mapping.views.render import Painter
from shared.rectify import RgbdImage

CHILDREN = 10  # Gaussians per anchor
ITERATION_STAGES = "decode", "rasterize", "loss", "backward", "update"


@dataclass
class Stages:
    """Seconds of every stage of every iteration."""

    times: dict[str, list[float]] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Note how long the block takes."""
        start = time.perf_counter()
        yield
        self.times.setdefault(name, []).append(time.perf_counter() - start)


class MappingIteration:
    """The mapper's work on one keyframe of a map of so many Gaussians, on their device.

    Each anchor has 10 children in its own frame, as in the mapper; children stand where the given
    Gaussians do and have their colours and, on average, their sizes.
    """

    def __init__(self, rasterizer: Rasterizer, gaussians: Gaussians, view: View) -> None:
        self._config = MappingConfig(anchors=AnchorConfig(children=CHILDREN))
        self._view, self.stages = view, Stages()
        self._device = device = gaussians.means.device
        self._loss = mapping_loss_cpu if device.type == "cpu" else mapping_loss
        anchors = AnchorMap(self._config.anchors, device)
        anchors.append(_anchors(gaussians), creator_seq=0)
        decoder = NeuralDecoder(self._config, seed=0, device=device)
        self._painter = Painter(anchors, decoder, rasterizer, self._config.decoder)
        self._target = self._darker()

    def run(self) -> None:
        """One step towards an image that is a little darker than the first one."""
        exposure = torch.tensor([[1.0] * 3, [0.0] * 3], device=self._device, requires_grad=True)
        appearance = Appearance(torch.zeros(3, device=self._device), exposure)
        with self.stages("decode"):
            visible, gaussians = self._painter.decode(self._view, is_trained=True)
        with self.stages("rasterize"):
            rendered = self._painter.rasterizer(gaussians, self._view)
        with self.stages("loss"):
            loss = self._loss(rendered, self._target, appearance, self._config.loss)
        with self.stages("backward"):
            loss.total.backward()
        with self.stages("update"), torch.no_grad():
            step = begin_step(self._painter.anchors.rows, visible.index)
            for name in trained_widths(self._config.anchors):
                adam_rows(step, name, getattr(visible, name).grad, 1e-6)
            self._painter.decoder.step(self._config.rates)

    def _darker(self) -> Target:
        rendered = self._painter.draw(self._view).rendered
        colour = (255.0 * 0.9 * rendered.colour).clamp(0.0, 255.0).to(torch.uint8).cpu().numpy()
        depth = (rendered.depth / rendered.alpha.clamp_min(0.5)).cpu().numpy()
        image = RgbdImage(colour, depth, self._view.intrinsics)
        return Target.of(image, self._device)


def _anchors(gaussians: Gaussians) -> NewAnchors:
    means, scales, _, _, colours = (_children(tensor) for tensor in gaussians.tensors())
    count = len(means)
    positions = means.mean(axis=1)
    features = np.zeros((count, FEATURES), np.float32)
    logits = np.clip(colours, 0.02, 0.98)
    logits = np.log(logits / (1.0 - logits))
    features[:, : 3 * CHILDREN] = logits.reshape(count, -1)
    sizes = np.zeros((count, 6), np.float32)
    sizes[:, 3:] = np.log(2.0 * scales).mean(axis=1)  # the networks start at half of it
    return NewAnchors(
        positions=positions,
        features=features,
        offsets=(means - positions[:, None]).reshape(count, -1),
        scalings=sizes,
        keys=np.arange(count),
        is_primary=np.zeros(count, np.bool_),
    )


def _children(tensor: Tensor) -> np.ndarray:
    """Rows in groups of one anchor each."""
    rows = tensor.detach().cpu().numpy()
    return rows.reshape(len(rows) // CHILDREN, CHILDREN, -1)
