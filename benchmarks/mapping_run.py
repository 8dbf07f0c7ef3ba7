"""One map made from a sequence's true poses: fed online, refined, and scored on the way."""

from __future__ import annotations

import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pointslam.datasets import FileSequence, is_held_out, open_sequence
from pointslam.evaluation.protocol import EvaluationOutput, block, novel_block, score_run
from services.mapping.config import MappingConfig
from services.mapping.pipeline import Mapper, NewKeyframe
from services.mapping.sessions.figures import MapFigures
from services.mapping.warm_up import warm_up
from shared.camera import Intrinsics
from shared.config import override, read_overrides
from shared.errors import PointSlamError
from shared.frames import Frame
from shared.maps import RenderReply, RenderRequest
from shared.rectify import RgbdImage, rectify
from shared.se3 import Matrix
from shared.tracks import KeyframePoses


@dataclass(frozen=True)
class RunPlan:
    """What one map is made from."""

    sequence: Path
    frames: int  # the first so many; 0 for all
    every: int  # frames between keyframes
    holdout: int
    iterations: int | None  # a frame; None for the setting
    refine: int  # iterations after the last frame
    scores: int  # parts of the refinement with a score after each
    seed: int
    settings: tuple[str, ...]


class MappingRun:
    """A mapper, the frames that it is fed, and the seconds it took."""

    def __init__(self, plan: RunPlan) -> None:
        config = override(MappingConfig(), read_overrides(None, plan.settings))
        self._plan = plan
        self._sequence: FileSequence = open_sequence(plan.sequence)
        self._count = min(len(self._sequence), plan.frames or len(self._sequence))
        self._mapper = Mapper(self._sequence.calibration, config, plan.seed, torch.device("cpu"))
        self._per_frame = plan.iterations
        if plan.iterations is None:
            self._per_frame = config.schedule.iterations_per_frame
        self._seconds = 0.0

    def measure(self) -> dict[str, Any]:
        """Feed, refine and score; figures in JSON's types."""
        self._feed()
        curve = [self._score("online")]
        stages = self._mapper.stages.medians()
        parts = self._plan.scores if self._plan.refine else 0
        for part in range(parts):
            bounds = (part * self._plan.refine // parts, (part + 1) * self._plan.refine // parts)
            self._refine(*bounds)
            curve.append(self._score("refined"))
        return {
            "settings": list(self._plan.settings),
            "keyframes": len(self._mapper.views),
            "curve": curve,
            "insert_keyframe_ms": stages["insert_keyframe"],
            "iteration_ms": stages["iteration"],
            "stages_ms": stages,
            "map": vars(MapFigures.of(self._mapper)),
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        }

    def _feed(self) -> None:
        """The sequence as the mapping service would be fed; its own time only is counted."""
        keyframes: dict[int, Matrix] = {}
        newest = -self._plan.every
        for index in range(self._count):
            if index - newest >= self._plan.every and not self._is_held_out(index):
                newest, keyframes[index] = index, true_pose(self._sequence, index)
                keyframe = new_keyframe(self._sequence, index, keyframes)
                start = time.perf_counter()
                self._mapper.insert_keyframe(keyframe)
                self._seconds += time.perf_counter() - start
            start = time.perf_counter()
            self._mapper.iterate(self._per_frame or 0)
            self._seconds += time.perf_counter() - start

    def _refine(self, first: int, last: int) -> None:
        start = time.perf_counter()
        for done in range(first, last):
            self._mapper.refine(done / self._plan.refine)
        self._seconds += time.perf_counter() - start

    def _score(self, phase: str) -> dict[str, Any]:
        """Every third frame, the held-out ones among them, and the views off the path."""
        scored = [i for i in range(self._count) if i % 3 == 0 or self._is_held_out(i)]
        poses = {i: true_pose(self._sequence, i) for i in scored}
        with tempfile.TemporaryDirectory() as folder:
            output = EvaluationOutput(Path(folder), self._plan.holdout, lambda done, total: None)
            drawing = _Drawing(self._mapper, self._sequence.calibration.colour.intrinsics)
            scores = score_run(drawing, self._sequence, poses, np.eye(4), output)
        held_out = [score for score in scores.frames if self._is_held_out(score.index)]
        return {
            "phase": phase,
            "iterations": self._mapper.iterations,
            "seconds": self._seconds,
            "all": block(scores.frames),
            "heldout": block(held_out),
            "novel": novel_block(scores.views),
        }

    def _is_held_out(self, index: int) -> bool:
        return is_held_out(index, self._plan.holdout)


@dataclass(frozen=True)
class _Drawing:
    """A mapper as evaluation wants it."""

    mapper: Mapper
    camera: Intrinsics

    def render(
        self,
        T_world_camera: NDArray[np.float64],
        intrinsics: Intrinsics | None = None,
        appearance_t_ns: int | None = None,
    ) -> RenderReply:
        """A view of the map."""
        request = RenderRequest(T_world_camera, intrinsics or self.camera, appearance_t_ns)
        return self.mapper.render(request)


def measure(plan: RunPlan) -> dict[str, Any]:
    """Make and score one map in this process, of which it is the only one."""
    warm_up()
    return MappingRun(plan).measure()


def true_pose(sequence: FileSequence, index: int) -> Matrix:
    """`T_world_camera` [4, 4] of a frame."""
    pose = sequence.truth(index)
    if pose is None:
        raise PointSlamError(f"frame {index} of {sequence.name} has no true pose")
    return pose


def orb_points(image: RgbdImage, T_world_camera: Matrix) -> NDArray[np.float64]:
    """ORB keypoints with depth, in the world, [L, 3]: what tracking would call landmarks."""
    grey = cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY)
    keypoints = cv2.ORB_create(1000).detect(grey, None)  # pyright: ignore
    uv = np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2)
    z = image.depth_m[uv[:, 1].astype(int), uv[:, 0].astype(int)].astype(np.float64)
    uv, z, k = uv[z > 0], z[z > 0], image.intrinsics
    points = np.stack([(uv[:, 0] - k.cx) / k.fx * z, (uv[:, 1] - k.cy) / k.fy * z, z], axis=1)
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def new_keyframe(sequence: FileSequence, index: int, keyframes: dict[int, Matrix]) -> NewKeyframe:
    """The keyframe with the poses of all before it."""
    recorded = sequence.frame(index)
    frame = Frame(seq=index, t_ns=recorded.t_ns, rgb=recorded.rgb, depth=recorded.depth)
    landmarks = orb_points(rectify(frame, sequence.calibration), keyframes[index])
    seqs, poses = np.array(list(keyframes), np.int64), np.stack(list(keyframes.values()))
    return NewKeyframe(frame, KeyframePoses(len(seqs), seqs, poses), landmarks)
