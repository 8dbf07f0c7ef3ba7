"""The plots of a report, as PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from pointslam.evaluation.metrics import TrajectoryScores
from pointslam.evaluation.protocol import Scores
from pointslam.evaluation.trajectory import Poses

matplotlib.use("Agg")

_SIZE_INCH = (5.8, 3.8)  # shown half a page wide, or a phone's width
_DPI = 200
_PER_KEYFRAME = "insert_keyframe"
_WHOLE_ITERATION = "iteration"


@dataclass(frozen=True)
class Track:
    """A trajectory in the true world's frame, by frame index; `lost` are where frames got lost."""

    estimated: Poses
    truth: Poses
    keyframes: tuple[int, ...]
    lost: NDArray[np.float64]  # [N, 3], m


def trajectory_plot(track: Track) -> bytes:
    """Both trajectories, along the two directions in which the camera moved most."""
    ours, theirs = _positions(track.estimated), _positions(track.truth)
    keyframes = _positions({i: track.estimated[i] for i in track.keyframes})
    plane = _main_plane(np.concatenate([ours, theirs])).T

    def draw(axes: Axes) -> None:
        if len(theirs):
            axes.plot(*(theirs @ plane).T, color="0.7", linewidth=4, label="truth")
        axes.plot(*(ours @ plane).T, color="tab:blue", linewidth=1.2, label="estimated, final")
        axes.plot(*(keyframes @ plane).T, ".", color="tab:blue", markersize=5, label="keyframes")
        if len(track.lost):
            axes.plot(*(track.lost @ plane).T, "x", color="tab:red", label="lost frames")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(title="Trajectory, in the plane of most motion", xlabel="m", ylabel="m")
        axes.legend(fontsize="small")

    return _png(draw)


def error_plot(scores: TrajectoryScores) -> bytes:
    """Position errors and relative errors over frames."""

    def draw(axes: Axes) -> None:
        if scores.relative is not None:
            indices, errors_cm = scores.relative.indices, 100 * scores.relative.translations_m
            axes.plot(indices, errors_cm, linewidth=0.8, color="0.6", label="RPE, 30 frames")
        for label, errors, width in (("online", scores.online, 3), ("final", scores.final, 1)):
            if errors is not None:  # the two often coincide
                errors_cm = 100 * errors.errors_m
                axes.plot(errors.indices, errors_cm, linewidth=width, label=f"ATE {label}")
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
        axes.plot(frame_seqs, frame_ms, ".", markersize=4)
        median = float(np.median(frame_ms))
        axes.axhline(median, color="0.5", linewidth=1, label=f"median, {median:.0f} ms")
        axes.set(title="Tracking time inside the worker", xlabel="frame", ylabel="ms")
        axes.set_ylim(bottom=0)
        axes.legend()

    return _png(draw)


def stages_plot(tracking_ms: dict[str, float], mapping_ms: dict[str, float]) -> bytes:
    """Median time of each stage: of a frame's tracking, and of one mapping iteration."""
    bars = [(name, value, "tab:blue") for name, value in tracking_ms.items()]
    for name, value in mapping_ms.items():
        if name != _WHOLE_ITERATION:
            label = f"{name} (once a keyframe)" if name == _PER_KEYFRAME else name
            bars.append((label, value, "tab:orange"))

    def draw(axes: Axes) -> None:
        places = np.arange(len(bars))
        names, values, colours = zip(*bars, strict=True)
        drawn = axes.barh(places, values, color=colours, height=0.7)
        axes.bar_label(drawn, fmt="%.1f", padding=3, fontsize="small")
        axes.set_yticks(places, [name.replace("_", " ") for name in names], fontsize="small")
        axes.invert_yaxis()
        axes.margins(x=0.12)
        axes.grid(visible=False, axis="y")
        axes.set(title="Stages of a frame and of an iteration", xlabel="ms (median)")
        patches = [Patch(color="tab:blue"), Patch(color="tab:orange")]
        axes.legend(patches, ["tracking", "mapping"], loc="lower right")

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
    axes.set_axisbelow(True)
    draw(axes)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
