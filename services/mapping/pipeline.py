"""The mapper: keyframes in, a map of neural Gaussians that renders any view.

It takes values and returns values and never sees the bus; one thread at a time, except that any
thread may ask for renders.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.anchors import densification
from services.mapping.anchors.anchor_map import AnchorMap, trained_widths
from services.mapping.anchors.carving import carve
from services.mapping.anchors.placement import Placement
from services.mapping.anchors.seeding import SeedRequest, seed_anchors
from services.mapping.config import LearningRates, MappingConfig
from services.mapping.decoding.decoders import decoder_for
from services.mapping.decoding.environment import Environment
from services.mapping.decoding.optimizer import Youth, adam_rows, begin_step
from services.mapping.losses.cpu import mapping_loss_cpu
from services.mapping.losses.mapping_loss import Appearance, Target, mapping_loss
from services.mapping.map_state import MapState, as_arrays, as_tensors, flatten, unflatten
from services.mapping.rasterizer import View, rasterizer_for
from services.mapping.views.alignment import aligning_twist
from services.mapping.views.appearance import ExposureModel
from services.mapping.views.colour_fusion import fuse_colours
from services.mapping.views.coverage import uncovered_pixels
from services.mapping.views.exposure_fit import fitted_exposure
from services.mapping.views.first_look import first_look, resized
from services.mapping.views.guessed_depth import with_guesses
from services.mapping.views.render import Drawn, Painter, to_images
from services.mapping.views.render_cache import Moment
from services.mapping.views.running_psnr import RunningPsnr
from services.mapping.views.sightings import Sightings
from services.mapping.views.training_views import MovingCells, TrainingView, TrainingViews
from shared import se3
from shared.camera import Calibration
from shared.frames import Frame
from shared.maps import RenderReply, RenderRequest
from shared.rectify import RgbdImage
from shared.telemetry import StageTimes
from shared.tracks import KeyframePoses


@dataclass(frozen=True)
class NewKeyframe:
    """A keyframe and what the geometry side of the map says at that moment."""

    frame: Frame
    poses: KeyframePoses  # of all keyframes, this one included
    landmarks_world: NDArray[np.float64]  # [L, 3], ORB points that it saw
    moving_cells: NDArray[np.bool_] | None = None  # of `KeyframeData`

    @property
    def T_world_camera(self) -> NDArray[np.float64]:
        """The keyframe's own pose, [4, 4]."""
        return self.poses.T_world_keyframes[self.poses.seqs == self.frame.seq][0]


class Mapper:
    """The anchor map of one session with its networks, optimizer and training views."""

    def __init__(
        self, calibration: Calibration, config: MappingConfig, seed: int, device: torch.device
    ) -> None:
        self.config = config
        self._device = device
        self.anchors = AnchorMap(
            config.anchors, device, is_gated=config.densification.rule == "halving"
        )
        self.decoder = decoder_for(config, seed, device)
        self._environment = Environment(config, seed, device)
        self.painter = Painter(
            self.anchors, self.decoder, rasterizer_for(device.type), config.decoder
        )
        self.exposures = ExposureModel()
        self.views = TrainingViews(
            calibration, config.schedule, seed, lambda image: Target.of(image, device)
        )
        self.sightings = Sightings(calibration)
        self._placement = Placement(config.schedule)
        self._youth = Youth(config.anchors.young_boost, config.anchors.young_steps)
        self._loss = mapping_loss_cpu if device.type == "cpu" else mapping_loss
        self._rng = np.random.default_rng([seed, 0])
        self._background = np.zeros(3, np.float32)
        self._changing = threading.Lock()  # held while what a render reads is not consistent
        self.iterations = 0
        self.revision = 0
        self.stages = StageTimes()
        self._psnr = RunningPsnr()

    @property
    def moment(self) -> Moment:
        """Changes whenever a view of the map may."""
        return Moment(self.revision, self.iterations)

    @property
    def psnr_db(self) -> float | None:
        """Mean PSNR of the last training views, None before the first."""
        return self._psnr.mean_db

    def insert_keyframe(self, keyframe: NewKeyframe) -> int:
        """Seed the map where a new keyframe shows what the map lacks; returns new anchors.

        "When the current frame is determined to be a keyframe, we add new anchor points to the
        map based on the ORB feature points and their corresponding depth information", secondary
        ones "only to non-overlapping regions of the new keyframe".

        Raises:
            InputError: an image of the keyframe cannot be decoded.
        """
        with self.stages.stage("insert_keyframe"), self._changing:
            self._follow_corrections(keyframe.poses)
            image = self._add_view(keyframe)
            pose, config = keyframe.T_world_camera, self.config.anchors
            carve(self.anchors, image, pose, config)
            is_uncovered = self._look_at(keyframe, image)
            landmarks, exposure = keyframe.landmarks_world, self.exposures.of(keyframe.frame.seq)
            request = SeedRequest(image, pose, is_uncovered, landmarks, exposure)
            request = with_guesses(request, self.sightings, self.views.all(), config)
            new = seed_anchors(request, self.anchors.keys(), config, self._rng)
            self.revision = keyframe.poses.revision
            added = self.anchors.append(new, keyframe.frame.seq)
            self._environment.initialise(self.anchors, added, pose[:3, 3])
            return added

    def iterate(self, count: int = 1) -> None:
        """Optimise on so many draws of keyframes (paper Eq. 8); nothing without keyframes."""
        for _ in range(count if len(self.views) else 0):
            self._step(self.views.draw(), self.config.rates)

    def refine(self, progress: float) -> None:
        """One iteration of a refinement, at 0 <= `progress` < 1 of it; rates decay with it."""
        if len(self.views):
            rates = self.config.refinement.at(progress)
            self._step(self.views.draw_in_rounds(), rates, progress)

    def render(self, request: RenderRequest) -> RenderReply:
        """A view of the map, with the exposure of a time or the mean one."""
        return self.render_at(request)[1]

    @torch.no_grad()
    def render_at(self, request: RenderRequest) -> tuple[Moment, RenderReply]:
        """A view, and which map it shows; waits while a step writes, and draws beside the next."""
        view = View(se3.inverse(request.T_world_camera), request.intrinsics)
        with self._changing:
            moment = self.moment
            visible, gaussians = self.painter.decode(view, is_trained=False)
            exposure = torch.from_numpy(self.exposures.at(request.appearance_t_ns))
            appearance = self._appearance(exposure.to(self._device))
            keyframes = self.views.all()
        drawn = Drawn(visible, gaussians, self.painter.rasterizer(gaussians, view))
        images = to_images(drawn, appearance)
        confidence = self.sightings.confidence(images, view, keyframes)
        return moment, RenderReply(moment.revision, *images, confidence)

    def state(self, room: Mapping[str, Tensor] | None = None) -> MapState:
        """Everything that a snapshot needs to go on exactly as if nothing had happened.

        Quick where there is `room` for the anchors, from `anchors.rows.room()`.
        """
        groups = {
            "anchors": self.anchors.state(room),
            **self.decoder.state(),
            **self._environment.state(),
            "exposures": as_tensors(self.exposures.state()),
            "mapper": as_tensors(
                {
                    "background": self._background,
                    **self._placement.state(),
                    "squared_errors": self._psnr.state(),
                }
            ),
        }
        values = {
            "iterations": self.iterations,
            "revision": self.revision,
            "generator": self._rng.bit_generator.state,
            "views": self.views.state(),
        }
        return MapState(flatten(groups), values)

    def restore(self, state: MapState, frames: Mapping[int, Frame], moving: MovingCells) -> None:
        """Take up a `state()`; `frames` has at least the keyframes that it names."""
        groups = unflatten(state.tensors)
        self.anchors.restore(groups["anchors"])
        self.decoder.restore(groups)
        self._environment.restore(groups)
        self.exposures.restore(as_arrays(groups["exposures"]))
        mapper = as_arrays(groups["mapper"])
        self._background = mapper["background"].copy()
        self._placement.restore(mapper)
        self._psnr.restore(mapper["squared_errors"])
        self.iterations = state.values["iterations"]
        self.revision = state.values["revision"]
        self._rng.bit_generator.state = state.values["generator"]
        self.views.restore(state.values["views"], frames, moving)

    def _step(self, keyframe: TrainingView, rates: LearningRates, progress: float = 0.0) -> None:
        """One optimisation step on one keyframe, at 0 <= `progress` < 1 of a refinement."""
        with self.stages.stage("target"):
            target = self.views.target(keyframe.seq)
        exposure = torch.from_numpy(self.exposures.of(keyframe.seq)).to(self._device)
        appearance = self._appearance(exposure.requires_grad_())
        with self.stages.stage("iteration"):
            drawn = self._draw(View(se3.inverse(keyframe.T_world_camera), target.intrinsics))
            if len(drawn.visible.index) == 0:  # a keyframe without depth, far from the map
                return
            with self.stages.stage("loss"):
                loss = self._loss(drawn.rendered, target, appearance, self.config.loss)
            if not bool(loss.total.isfinite()):
                return
            with self.stages.stage("backward"):
                loss.total.backward()
            with self.stages.stage("update"), self._changing:
                self._update(drawn, rates)
                assert exposure.grad is not None
                self.exposures.step(keyframe.seq, exposure.grad.cpu().numpy(), rates)
                self._densify(drawn, progress)
            if rates.poses > 0:
                twist = aligning_twist(drawn.rendered, target, appearance)
                self.views.align(keyframe.seq, twist, rates.poses)
        self._psnr.add(float(loss.squared_error))

    def _draw(self, view: View) -> Drawn:
        with self.stages.stage("decode"):
            visible, gaussians = self.painter.decode(view, is_trained=True)
        with self.stages.stage("rasterize"):
            return Drawn(visible, gaussians, self.painter.rasterizer(gaussians, view))

    @torch.no_grad()
    def _update(self, drawn: Drawn, rates: LearningRates) -> None:
        """Adam over the visible anchors and the networks."""
        self._environment.step(self.anchors, drawn.visible, rates)
        step = begin_step(self.anchors.rows, drawn.visible.index, self._youth)
        for name in trained_widths(self.config.anchors):
            gradient = getattr(drawn.visible, name).grad
            adam_rows(step, name, gradient, getattr(rates, name))
        self.decoder.step(rates)

    @torch.no_grad()
    def _densify(self, drawn: Drawn, progress: float) -> None:
        """Grow where the screen gradient stays large, cull what hardly shows."""
        config = self.config.densification
        self.iterations += 1
        densification.record(
            self.anchors,
            drawn.visible.index,
            drawn.gaussians.opacities,
            drawn.rendered.screen.gradient_norm,
        )
        if self.iterations % config.cull_interval == 0:
            densification.cull(self.anchors, config)
        is_growing = self.iterations >= config.first_iteration and progress < config.grow_until
        if is_growing and self.iterations % config.grow_interval == 0:
            densification.grow(self.anchors, config, self.config.anchors, self._rng)

    def _follow_corrections(self, poses: KeyframePoses) -> None:
        """Where a keyframe was corrected, its anchors go with it."""
        for seq, T_world_camera in zip(poses.seqs.tolist(), poses.T_world_keyframes, strict=True):
            if seq in self.views:
                self.views.set_pose(seq, T_world_camera)
                self._placement.follow(seq, T_world_camera, self.anchors)

    def _add_view(self, keyframe: NewKeyframe) -> RgbdImage:
        frame, pose = keyframe.frame, keyframe.T_world_camera
        view = TrainingView(frame.seq, frame.t_ns, frame, pose, keyframe.moving_cells)
        image = self.views.add(view)
        self.sightings.add(frame.seq, image)
        self._placement.add(frame.seq, pose)
        self.exposures.add(frame.seq, frame.t_ns)
        mean = image.mean_colour() / np.float32(255.0)
        self._background += (mean - self._background) / len(self.views)
        return image

    def _look_at(self, keyframe: NewKeyframe, image: RgbdImage) -> NDArray[np.bool_]:
        """Take over a keyframe's exposure and colours; returns what the map lacks, [H, W]."""
        if len(self.anchors) == 0:
            return np.ones(image.depth_m.shape, bool)
        seq, config = keyframe.frame.seq, self.config.anchors
        look = first_look(self.painter, image, keyframe.T_world_camera)
        is_uncovered = uncovered_pixels(look, config)
        fitted = fitted_exposure(look, self.exposures.of(seq), self.config.exposure)
        if fitted is not None:
            self.exposures.set(seq, fitted)
            appearance = self._appearance(torch.from_numpy(fitted).to(self._device))
            fuse_colours(self.anchors, look, ~is_uncovered, appearance, config.fusion_steps)
        return resized(is_uncovered, *image.depth_m.shape)

    def _appearance(self, exposure: Tensor) -> Appearance:
        background = torch.from_numpy(self._background.copy())
        return Appearance(background.to(self._device), exposure)
