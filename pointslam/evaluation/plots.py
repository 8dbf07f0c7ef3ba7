"""The plots of a report, as PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Callable

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pointslam.evaluation.metrics import TrajectoryScores
from pointslam.evaluation.protocol import Scores
from pointslam.evaluation.trajectory import Poses
from shared import se3
from shared.se3 import Matrix

matplotlib.use("Agg")

_SIZE_INCH = (7.0, 3.2)
_DPI = 110


def trajectory_plot(estimated: Poses, truth: Poses, T_truth_map: Matrix) -> bytes:
    """Both trajectories from above: along the two directions in which the camera moved most."""
    ours = se3.transform(T_truth_map, _positions(estimated))
    theirs = _positions(truth)
    plane = _main_plane(np.concatenate([ours, theirs]) if len(theirs) else ours)

    def draw(axes: Axes) -> None:
        if len(theirs):
            axes.plot(*(theirs @ plane.T).T, color="0.6", linewidth=3, label="truth")
        axes.plot(*(ours @ plane.T).T, color="tab:blue", linewidth=1.2, label="estimated, final")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(title="Trajectory from above", xlabel="m", ylabel="m")
        axes.legend()

    return _png(draw)


def error_plot(scores: TrajectoryScores) -> bytes:
    """Position errors and relative errors over frames."""

    def draw(axes: Axes) -> None:
        for label, errors in (("online", scores.online), ("final", scores.final)):
            if errors is not None:
                axes.plot(errors.indices, 100 * errors.errors_m, linewidth=1, label=f"ATE {label}")
        if scores.relative is not None:
            indices, errors_cm = scores.relative.indices, 100 * scores.relative.translations_m
            axes.plot(indices, errors_cm, linewidth=0.8, color="0.5", label="RPE, 30 frames")
        axes.set(title="Trajectory errors", xlabel="frame", ylabel="cm")
        axes.set_ylim(bottom=0)
        axes.legend()

    return _png(draw)


def psnr_plot(scores: Scores, held_out: Callable[[int], bool]) -> bytes:
    """PSNR of every frame, held-out ones marked."""
    points = [(s.index, s.psnr_db) for s in scores.frames if s.psnr_db is not None]
    kept = [point for point in points if held_out(point[0])]

    def draw(axes: Axes) -> None:
        axes.plot(*np.array(points).reshape(-1, 2).T, linewidth=1, label="all frames")
        axes.plot(*np.array(kept).reshape(-1, 2).T, "o", markersize=3, label="held out")
        axes.set(title="PSNR", xlabel="frame", ylabel="dB")
        axes.legend()

    return _png(draw)


def time_plot(frame_seqs: tuple[int, ...], frame_ms: tuple[float, ...]) -> bytes:
    """Tracking time of every frame."""

    def draw(axes: Axes) -> None:
        axes.plot(frame_seqs, frame_ms, ".", markersize=3)
        axes.set(title="Tracking time inside the worker", xlabel="frame", ylabel="ms")
        axes.set_ylim(bottom=0)

    return _png(draw)


def _positions(poses: Poses) -> NDArray[np.float64]:
    return np.array([poses[i][:3, 3] for i in sorted(poses)]).reshape(-1, 3)


def _main_plane(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two orthonormal directions, [2, 3], of the largest spread."""
    centred = positions - positions.mean(axis=0)
    _, directions = np.linalg.eigh(centred.T @ centred)
    return directions[:, ::-1].T[:2]


def _png(draw: Callable[[Axes], None]) -> bytes:
    figure = Figure(figsize=_SIZE_INCH, dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    axes.grid(color="0.9")
    draw(axes)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
