"""Which views are scored, from which poses: on a map that is a real scene, moved."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

from pointslam.datasets import SequenceOptions, open_sequence
from pointslam.evaluation.evaluate import Evaluation, write_evaluation
from pointslam.evaluation.metrics import (
    image_entries,
    map_entries,
    memory_entry,
    provenance,
    score_trajectories,
    tracking_entry,
)
from pointslam.evaluation.protocol import EvaluationOutput, score_run
from pointslam.evaluation.report import text_table
from pointslam.run_folder import RunFolder, RunRecord
from pointslam.synth import SynthOptions
from pointslam.synth.record import render_frame
from pointslam.synth.scene import Scene
from shared import se3
from shared.maps import RenderReply

T_MAP_WORLD = se3.exp([0.3, -0.2, 0.1, 0.2, 0.5, -0.1])
OPTIONS_OF_READING = SequenceOptions(depth_scale=5208.0)


class SceneMap:
    """A map that shows a procedural scene in a frame of its own."""

    def __init__(self, scene: Scene, options: SynthOptions) -> None:
        self._options = options
        self._scene = scene

    def render(self, T_world_camera, intrinsics=None, appearance_t_ns=None) -> RenderReply:
        pose = se3.inverse(T_MAP_WORLD) @ T_world_camera
        rgb, depth_m = render_frame(self._scene, pose, self._options, np.random.default_rng(0))
        opaque = np.full(depth_m.shape, 255, np.uint8)
        return RenderReply(1, rgb, depth_m, opaque, opaque)


@pytest.fixture(scope="module")
def evaluation(room, lit_scene, room_options, tmp_path_factory):
    poses = {i: T_MAP_WORLD @ room.truth(i) for i in range(len(room)) if i != 7}
    trajectories = score_trajectories(room, poses, poses)
    assert trajectories.final is not None
    output = EvaluationOutput(tmp_path_factory.mktemp("renders"), 8, lambda done, total: None)
    scores = score_run(
        SceneMap(lit_scene, room_options), room, poses, trajectories.final.T_truth_map, output
    )
    keyframes, lost = (0, 8, 16), (poses[6],)
    return Evaluation(poses, poses, trajectories, scores, keyframes, lost), output.folder


def test_every_frame_with_a_pose_is_scored_once(evaluation):
    scored = [score.index for score in evaluation[0].images.frames]

    assert scored == [i for i in range(34) if i != 7]


def test_depth_agrees_when_poses_do(evaluation):
    entries = image_entries(evaluation[0].images, 8)

    assert entries["all"]["depth_l1_m"] == pytest.approx(0.0, abs=1e-3)


def test_novel_views_are_brought_into_the_map_by_the_alignment(evaluation):
    entries = image_entries(evaluation[0].images, 8)

    assert len(evaluation[0].images.views) == 2
    assert entries["novel"]["depth_l1_m"] == pytest.approx(0.0, abs=5e-3)
    assert entries["novel"]["seen"] == 1.0


def test_held_out_scores_are_of_the_held_out_frames_only(evaluation):
    scores = evaluation[0].images
    expected = [s.psnr_db for s in scores.frames if s.index in (4, 12, 20, 28)]

    assert image_entries(scores, 8)["heldout"]["psnr_db"] == pytest.approx(np.mean(expected))
    assert image_entries(scores, 0)["heldout"]["psnr_db"] is None


def test_pictures_of_held_out_and_novel_views_are_written(evaluation):
    names = {path.name for path in evaluation[1].iterdir()}

    assert {"frame_00004.png", "novel_00000.png"} <= names


def test_no_truth_means_no_novel_scores(room, lit_scene, room_options, tmp_path):
    output = EvaluationOutput(tmp_path, 8, lambda done, total: None)
    poses = {0: np.eye(4)}

    scores = score_run(SceneMap(lit_scene, room_options), room, poses, None, output)

    assert image_entries(scores, 8)["novel"]["psnr_db"] is None


def test_without_depth_there_is_no_score_over_it(room, lit_scene, room_options, tmp_path):
    shutil.copytree(room.path, tmp_path / "blind")
    for path in (tmp_path / "blind" / "depth").iterdir():
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    blind = open_sequence(tmp_path / "blind")
    output = EvaluationOutput(tmp_path, 8, lambda done, total: None)

    scores = score_run(SceneMap(lit_scene, room_options), blind, {0: np.eye(4)}, None, output)

    entries = image_entries(scores, 8)
    assert (entries["gsicp"]["psnr_db"], entries["gsicp"]["ssim"]) == (None, None)
    assert entries["all"]["psnr_db"] is not None


def test_a_perceptual_distance_is_null_unless_one_is_given(
    evaluation, room, lit_scene, room_options, tmp_path
):
    output = EvaluationOutput(tmp_path, 8, lambda done, total: None, lambda *_: 0.25)

    scores = score_run(SceneMap(lit_scene, room_options), room, {0: np.eye(4)}, None, output)

    entries = image_entries(scores, 8)
    assert (entries["all"]["lpips"], entries["gsicp"]["lpips"]) == (0.25, 0.25)
    assert image_entries(evaluation[0].images, 8)["all"]["lpips"] is None


def full_metrics(evaluation, room):
    info = {"keyframes": 4, "loops": 1, "iteration_ms": None, "stages_ms": {}, "iterations": 0}
    info |= {"primary_anchors": 1, "secondary_anchors": 2, "map_bytes": 3}
    counts = {"sequence": room.name, "mode": "offline", "frames": 34, "tracked": 33}
    wall = {"tracking": 1.0, "mapping": 1.0, "refinement": 0.0, "total": 2.0}
    return {
        **counts,
        **{"lost": 1, "relocalized": 0, "seed": 0, "wall_s": wall, "input_fps": 34.0},
        **evaluation.entries(8),
        **map_entries(info),
        "tracking_ms": tracking_entry([], {"orb": 3.5}),
        "peak_rss_mb": memory_entry(None),
        **provenance(),
    }


def test_a_runs_folder_gets_trajectories_metrics_and_a_report(evaluation, room, tmp_path):
    folder = RunFolder(tmp_path)
    folder.renders.mkdir()
    record = RunRecord(
        "room",
        OPTIONS_OF_READING,
        "s",
        "offline",
        34,
        8,
        0,
        "cpu",
        frame_seqs=(0,),
        frame_ms=(9.0,),
    )
    metrics = full_metrics(evaluation[0], room)

    write_evaluation(folder, room, record, evaluation[0], metrics)

    lines = folder.trajectory("final").read_text().splitlines()
    assert len(lines) == 1 + 33
    assert lines[1].startswith("0.000000 ")
    assert json.loads(folder.metrics.read_text())["ate_final_rmse_m"] < 1e-6
    assert folder.report.read_text().count("data:image/png;base64,") == 5


def test_the_table_shows_nulls_as_dashes(evaluation, room):
    metrics = full_metrics(evaluation[0], room) | {
        "ate_online_rmse_m": None,
        "ate_final_rmse_m": None,
        "rpe30_trans_m": None,
    }

    table = text_table(metrics)

    assert "ATE online / final  - / -" in table
    assert "33 of 34, 1 lost" in table


def test_a_run_record_survives_its_file(tmp_path):
    record = RunRecord(
        "room",
        OPTIONS_OF_READING,
        "s",
        "live",
        3,
        8,
        1,
        "cpu",
        ("mapping.a=1",),
        (0, 1),
        (5.0, 6.5),
    )
    RunFolder(tmp_path).write_record(record)

    assert RunFolder(tmp_path).read_record() == record
