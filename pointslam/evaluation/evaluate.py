"""Scores a session against its sequence, and writes what a run's folder shows of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pointslam.client import Session
from pointslam.datasets.base import Sequence, is_held_out
from pointslam.evaluation import plots
from pointslam.evaluation.metrics import (
    TrajectoryScores,
    image_entries,
    score_trajectories,
    trajectory_entries,
)
from pointslam.evaluation.protocol import EvaluationOutput, Scores, score_run
from pointslam.evaluation.report import write_report
from pointslam.run_folder import RunFolder, RunRecord, tum_lines
from shared.frames import HAS_POSE, TrackingStatus
from shared.se3 import Matrix


@dataclass(frozen=True)
class Evaluation:
    """Poses by frame index, in the map, and all scores."""

    online: dict[int, Matrix]
    final: dict[int, Matrix]
    trajectories: TrajectoryScores
    images: Scores
    keyframes: tuple[int, ...] = ()
    lost: tuple[Matrix, ...] = ()  # the poses last known where frames were lost

    def entries(self, holdout: int) -> dict[str, Any]:
        """What metrics.json holds of it."""
        return trajectory_entries(self.trajectories) | image_entries(self.images, holdout)


def evaluate_session(session: Session, sequence: Sequence, output: EvaluationOutput) -> Evaluation:
    """Fetch poses and views of a session and score them."""
    records = session.trajectory()
    with_pose = [r for r in records if r.status in HAS_POSE]
    online = {r.seq: r.T_map_camera_online for r in with_pose}
    final = {r.seq: r.T_map_camera_final for r in with_pose}
    # A lost frame is drawn from where the client was told it last was: losing it costs dB.
    drawn = {r.seq: r.T_map_camera_online for r in records} | final
    trajectories = score_trajectories(sequence, online, final)
    T_truth_map = trajectories.final.T_truth_map if trajectories.final else None
    output.folder.mkdir(parents=True, exist_ok=True)
    images = score_run(session, sequence, drawn, T_truth_map, output)
    keyframes = tuple(r.seq for r in with_pose if r.keyframe)
    lost = tuple(r.T_map_camera_online for r in records if r.status is TrackingStatus.LOST)
    return Evaluation(online, final, trajectories, images, keyframes, lost)


def write_evaluation(
    folder: RunFolder,
    sequence: Sequence,
    record: RunRecord,
    evaluation: Evaluation,
    metrics: dict[str, Any],
) -> None:
    """Write trajectories, metrics.json and report.html."""
    for kind, poses in (("online", evaluation.online), ("final", evaluation.final)):
        indices = sorted(poses)
        stamps = [sequence.stamp(i) for i in indices]
        folder.trajectory(kind).write_text(tum_lines(stamps, [poses[i] for i in indices]))
    folder.write_metrics(metrics)
    pictures = sorted(folder.renders.glob("*.png"))
    pages = _plots(sequence, record, evaluation)
    stages = metrics["tracking_ms"]["stages"], metrics["mapping_ms_per_iteration"]["stages"]
    if any(stages):
        pages.append(plots.stages_plot(*stages))
    write_report(folder.report, metrics, pages, pictures)


def _plots(sequence: Sequence, record: RunRecord, evaluation: Evaluation) -> list[bytes]:
    pages = []
    if evaluation.final:
        pages.append(plots.trajectory_plot(_track(sequence, evaluation)))
    if evaluation.trajectories.final is not None:
        pages.append(plots.error_plot(evaluation.trajectories))
    if evaluation.images.frames:
        pages.append(plots.psnr_plot(evaluation.images, lambda i: is_held_out(i, record.holdout)))
    if record.frame_ms:
        pages.append(plots.time_plot(record.frame_seqs, record.frame_ms))
    return pages


def _track(sequence: Sequence, evaluation: Evaluation) -> plots.Track:
    scores = evaluation.trajectories.final
    T_truth_map = scores.T_truth_map if scores else np.eye(4)
    estimated = {i: T_truth_map @ T for i, T in evaluation.final.items()}
    known = {i: sequence.truth(i) for i in estimated}
    truth = {i: T for i, T in known.items() if T is not None}
    lost = np.array([(T_truth_map @ T)[:3, 3] for T in evaluation.lost]).reshape(-1, 3)
    return plots.Track(estimated, truth, evaluation.keyframes, lost)
