"""The blocks of metrics.json: which views are scored, from which poses, against which pictures.

all: every answered frame from its own final pose (a lost one from its last known), no mask.
heldout: those of them that were kept from training. novel: views off the trajectory, from the
true poses brought into the map by the alignment of the whole estimated trajectory.
gsicp: as `all`, both pictures times (depth > 0).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pointslam.datasets.base import Sequence, is_held_out
from pointslam.evaluation import images
from shared import se3
from shared.camera import Intrinsics
from shared.frames import ColourImage, DepthImage, Frame
from shared.images import decode_colour, encode_png
from shared.maps import RenderReply
from shared.rectify import RgbdImage, rectify, rectify_images
from shared.se3 import Matrix

_SEEN_ALPHA = 0.9 * 255
_NUM_SAVED = 6
_MAX_WAITING = 4

Progress = Callable[[int, int], None]
Distance = Callable[[images.Rgb, images.Rgb], float]


class Renderer(Protocol):
    """What draws the map: a client's session."""

    def render(
        self,
        T_world_camera: NDArray[np.float64],
        intrinsics: Intrinsics | None = None,
        appearance_t_ns: int | None = None,
    ) -> RenderReply:
        """A view of the map from a pose in its frame."""
        ...


@dataclass(frozen=True)
class ViewScore:
    """One picture's scores; `index` is the frame's or the view's."""

    index: int
    psnr_db: float | None
    ssim: float
    depth_l1_m: float | None
    lpips: float | None
    masked_psnr_db: float | None
    masked_ssim: float | None
    masked_lpips: float | None
    psnr_seen_db: float | None
    seen: float  # share of pixels with rendered alpha above 0.9


@dataclass(frozen=True)
class Scores:
    """Scores of all frames with a pose, and of the views off the trajectory."""

    frames: tuple[ViewScore, ...]
    views: tuple[ViewScore, ...]


@dataclass(frozen=True)
class _Task:
    index: int
    name: str
    T_map_camera: Matrix
    appearance_t_ns: int | None
    truth: Callable[[], RgbdImage]
    is_saved: bool


def score_run(
    renderer: Renderer,
    sequence: Sequence,
    poses: dict[int, Matrix],
    T_truth_map: Matrix | None,
    output: EvaluationOutput,
) -> Scores:
    """Render and score every frame of `poses` (final, in the map) and every novel view.

    Without `T_truth_map` (no ground truth) there are no novel scores.
    """
    frames = list(_frame_tasks(sequence, poses, output.holdout))
    views = [] if T_truth_map is None else list(_view_tasks(sequence, T_truth_map))
    scored = list(_score_all(renderer, frames + views, output))
    return Scores(tuple(scored[: len(frames)]), tuple(scored[len(frames) :]))


@dataclass(frozen=True)
class EvaluationOutput:
    """Where pictures go (rendered beside true), which frames were held out, who is told.

    `lpips` measures perceptual distances, where the user has weights for it.
    """

    folder: Path
    holdout: int
    progress: Progress
    lpips: Distance | None = None


def _frame_tasks(sequence: Sequence, poses: dict[int, Matrix], holdout: int) -> Iterator[_Task]:
    candidates = [i for i in poses if is_held_out(i, holdout)] or list(poses)
    saved = _spread(candidates)
    for index in sorted(poses):

        def truth(index: int = index) -> RgbdImage:
            frame = sequence.frame(index)
            return rectify(Frame(index, frame.t_ns, frame.rgb, frame.depth), sequence.calibration)

        t_ns = sequence.t_ns(index)
        yield _Task(index, f"frame_{index:05d}", poses[index], t_ns, truth, index in saved)


def _view_tasks(sequence: Sequence, T_truth_map: Matrix) -> Iterator[_Task]:
    T_map_truth = se3.inverse(T_truth_map)
    saved = _spread(list(range(sequence.num_views)))
    for index in range(sequence.num_views):
        view = sequence.view(index)

        def truth(rgb: ColourImage = view.rgb, depth: DepthImage | None = view.depth) -> RgbdImage:
            return _rectified_view(sequence, rgb, depth)

        T_map_camera = T_map_truth @ view.T_world_camera
        yield _Task(index, f"novel_{index:05d}", T_map_camera, None, truth, index in saved)


def _rectified_view(sequence: Sequence, rgb: ColourImage, depth: DepthImage | None) -> RgbdImage:
    calibration = sequence.calibration
    if depth is not None:
        return rectify(Frame(0, 0, rgb, depth), calibration)
    size = calibration.depth_camera().intrinsics
    nothing = np.zeros((size.height, size.width), np.float32)
    return rectify_images(decode_colour(rgb, calibration.colour.intrinsics), nothing, calibration)


def _spread(indices: list[int]) -> set[int]:
    ordered = sorted(indices)
    if len(ordered) <= _NUM_SAVED:
        return set(ordered)
    return {ordered[i] for i in np.linspace(0, len(ordered) - 1, _NUM_SAVED).astype(int)}


def _score_all(
    renderer: Renderer, tasks: list[_Task], output: EvaluationOutput
) -> Iterator[ViewScore]:
    """Render on this thread and score on another, a few pictures apart at most."""
    waiting: list[Future[ViewScore]] = []
    with ThreadPoolExecutor(1) as pool:
        for done, task in enumerate(tasks, 1):
            reply = renderer.render(task.T_map_camera, appearance_t_ns=task.appearance_t_ns)
            waiting.append(pool.submit(_score, task, reply, output))
            if len(waiting) > _MAX_WAITING:
                yield waiting.pop(0).result()
            output.progress(done, len(tasks))
        yield from (future.result() for future in waiting)


def _score(task: _Task, reply: RenderReply, output: EvaluationOutput) -> ViewScore:
    truth = task.truth()
    if task.is_saved:
        pair = np.concatenate([reply.rgb, truth.rgb], axis=1)
        (output.folder / f"{task.name}.png").write_bytes(encode_png(pair))
    is_seen = reply.alpha > _SEEN_ALPHA
    ours, theirs = images.masked(reply.rgb, truth.depth_m), images.masked(truth.rgb, truth.depth_m)
    lpips = output.lpips or (lambda *_: None)
    has_depth = bool((truth.depth_m > 0).any())  # black beside black is no picture
    return ViewScore(
        index=task.index,
        psnr_db=images.psnr_db(reply.rgb, truth.rgb),
        ssim=images.ssim(reply.rgb, truth.rgb),
        depth_l1_m=images.depth_l1_m(reply.depth_m, reply.alpha, truth.depth_m),
        lpips=lpips(reply.rgb, truth.rgb),
        masked_psnr_db=images.psnr_db(ours, theirs) if has_depth else None,
        masked_ssim=images.ssim(ours, theirs) if has_depth else None,
        masked_lpips=lpips(ours, theirs) if has_depth else None,
        psnr_seen_db=images.psnr_db(reply.rgb, truth.rgb, is_seen),
        seen=float(is_seen.mean()),
    )


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the values that there are; None if there is none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def block(scores: Iterable[ViewScore]) -> dict[str, float | None]:
    """The means that `all` and `heldout` show."""
    scores = list(scores)
    return {
        "psnr_db": mean(s.psnr_db for s in scores),
        "ssim": mean(s.ssim for s in scores),
        "lpips": mean(s.lpips for s in scores),
        "depth_l1_m": mean(s.depth_l1_m for s in scores),
    }


def novel_block(scores: Iterable[ViewScore]) -> dict[str, float | None]:
    """The means of views off the trajectory."""
    scores = list(scores)
    return block(scores) | {
        "psnr_seen_db": mean(s.psnr_seen_db for s in scores),
        "seen": mean(s.seen for s in scores),
    }


def gsicp_block(scores: Iterable[ViewScore]) -> dict[str, float | None]:
    """The means over pictures times (depth > 0)."""
    scores = list(scores)
    return {
        "psnr_db": mean(s.masked_psnr_db for s in scores),
        "ssim": mean(s.masked_ssim for s in scores),
        "lpips": mean(s.masked_lpips for s in scores),
    }
