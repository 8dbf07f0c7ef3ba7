"""The keyframes that the map is trained on: encoded images, present poses, and their draws."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from services.mapping.config import ScheduleConfig
from services.mapping.losses.mapping_loss import Target
from services.mapping.views.overlap import overlapping
from services.mapping.views.pose_offsets import PoseOffsets
from shared import se3
from shared.camera import Calibration
from shared.frames import Frame
from shared.pixel_cells import pixels_of
from shared.rectify import RgbdImage, rectify

V = TypeVar("V")
MakeTarget = Callable[[RgbdImage], Target]
MovingCells = Mapping[int, NDArray[np.bool_]]  # of the keyframes in which something moves


@dataclass(frozen=True)
class TrainingView:
    """A keyframe as the mapper keeps it; its images stay encoded."""

    seq: int
    t_ns: int
    frame: Frame
    T_world_camera: NDArray[np.float64]  # [4, 4]
    moving_cells: NDArray[np.bool_] | None = None  # of `KeyframeData`: not looked at

    def image(self, calibration: Calibration) -> RgbdImage:
        """The decoded and rectified image, without what moves.

        Raises:
            InputError: its images cannot be decoded.
        """
        image = rectify(self.frame, calibration)
        if self.moving_cells is None:
            return image
        return image.without(pixels_of(self.moving_cells, *image.depth_m.shape))


class RecentlyUsed(Generic[V]):
    """The newest `capacity` values that were asked for."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._values: OrderedDict[int, V] = OrderedDict()

    def get(self, key: int, make: Callable[[], V]) -> V:
        """The value of a key, made if it is not here."""
        if key not in self._values:
            self._values[key] = make()
        self._values.move_to_end(key)
        while len(self._values) > self._capacity:
            self._values.popitem(last=False)
        return self._values[key]


class TrainingViews:
    """All keyframes of a session, in order of their seq."""

    def __init__(
        self, calibration: Calibration, config: ScheduleConfig, seed: int, make_target: MakeTarget
    ) -> None:
        self._calibration = calibration
        self._config = config
        self._make_target = make_target
        self._views: dict[int, TrainingView] = {}
        self.offsets = PoseOffsets()
        self._overlapping: list[int] = []  # seqs that overlap the newest one's view
        self._order: list[int] = []  # seqs left in this round of a refinement
        self._is_newest_drawn = True
        self._rng = np.random.default_rng([seed, 1])
        pixels = calibration.colour.intrinsics.width * calibration.colour.intrinsics.height
        images = max(1, config.cached_images_mb * 1_000_000 // (pixels * 7))
        self._images: RecentlyUsed[RgbdImage] = RecentlyUsed(images)
        self._targets: RecentlyUsed[Target] = RecentlyUsed(config.cached_views)

    def __len__(self) -> int:
        return len(self._views)

    def __contains__(self, seq: int) -> bool:
        return seq in self._views

    def __getitem__(self, seq: int) -> TrainingView:
        return self._views[seq]

    def all(self) -> list[TrainingView]:
        """Every keyframe with its present pose, in order."""
        return list(self._views.values())

    def seqs(self) -> list[int]:
        """Seqs of all keyframes, ascending."""
        return list(self._views)

    def add(self, view: TrainingView) -> RgbdImage:
        """Add a keyframe, the newest one; returns its image.

        Raises:
            InputError: its images cannot be decoded; it is not added.
        """
        image = self._images.get(view.seq, lambda: view.image(self._calibration))
        self._views[view.seq] = view
        self._is_newest_drawn = False
        if self._config.draws == "overlapping":
            poses = [(seq, other.T_world_camera) for seq, other in self._views.items()]
            pose, share = view.T_world_camera, self._config.min_overlap
            self._overlapping = overlapping(image, pose, poses, share)
        return image

    def set_pose(self, seq: int, T_world_camera: NDArray[np.float64]) -> None:
        """Replace a keyframe's pose by another one of tracking's; its offset stays."""
        pose = T_world_camera @ self.offsets.of(seq)
        self._views[seq] = replace(self._views[seq], T_world_camera=pose)

    def align(self, seq: int, twist: NDArray[np.float64], rate: float) -> None:
        """Move a keyframe, not the first one, off tracking's pose: see `PoseOffsets.move`."""
        if seq == next(iter(self._views)):
            return
        T_world_camera = self._views[seq].T_world_camera @ se3.inverse(self.offsets.of(seq))
        self.offsets.move(seq, twist, rate)
        self.set_pose(seq, T_world_camera)

    def draw(self) -> TrainingView:
        """The newest keyframe once, then in a share of draws, else any one.

        What a keyframe brings is learned at once; more steps on it in a row only fit the map to
        one view. By the setting `draws`, the others are only those that overlap the newest one,
        as the paper's are.
        """
        seqs = self.seqs()
        if not self._is_newest_drawn or self._rng.random() < self._config.newest_share:
            self._is_newest_drawn = True
            return self._views[seqs[-1]]
        if self._config.draws == "overlapping":
            seqs = self._overlapping or seqs[-1:]
        return self._views[seqs[int(self._rng.integers(len(seqs)))]]

    def draw_in_rounds(self) -> TrainingView:
        """Every keyframe once a round, in random order: for refinement."""
        if not self._order:
            self._order = self._rng.permutation(self.seqs()).tolist()
        return self._views[self._order.pop()]

    def image(self, seq: int) -> RgbdImage:
        """The decoded and rectified image of a keyframe."""
        view = self._views[seq]
        return self._images.get(seq, lambda: view.image(self._calibration))

    def target(self, seq: int) -> Target:
        """What a render of a keyframe is compared with."""
        return self._targets.get(seq, lambda: self._make_target(self.image(seq)))

    def state(self) -> dict:
        """Poses, draws and the generator; not the images."""
        return {
            "seqs": self.seqs(),
            "poses": [view.T_world_camera.tolist() for view in self._views.values()],
            "offsets": self.offsets.state(),
            "order": list(self._order),
            "overlapping": list(self._overlapping),
            "is_newest_drawn": self._is_newest_drawn,
            "generator": self._rng.bit_generator.state,
        }

    def restore(self, state: dict, frames: Mapping[int, Frame], moving: MovingCells) -> None:
        """Take up a `state()`, with the frames of the keyframes that it names."""
        self._views = {
            seq: TrainingView(seq, frames[seq].t_ns, frames[seq], np.array(pose), moving.get(seq))
            for seq, pose in zip(state["seqs"], state["poses"], strict=True)
        }
        self.offsets.restore(state.get("offsets", []))  # older snapshots have none
        self._order = list(state["order"])
        self._overlapping = list(state["overlapping"])
        self._is_newest_drawn = state.get("is_newest_drawn", True)  # not in older snapshots
        self._rng.bit_generator.state = state["generator"]
