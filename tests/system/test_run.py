"""Whole runs through real services: every output is there, and scores can be had again."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pointslam.cli import main
from pointslam.run import RunOptions, evaluate_run, run_sequence
from pointslam.run_folder import RunFolder
from pointslam.synth import SynthOptions, record_scene
from shared.camera import Intrinsics

pytestmark = pytest.mark.system

SMALL = Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
NUM_FRAMES = 14


@pytest.fixture(scope="module")
def sequence(tmp_path_factory, lit_scene) -> Path:
    folder = tmp_path_factory.mktemp("sequence") / "room"
    options = SynthOptions(num_frames=NUM_FRAMES, num_views=2, camera=SMALL)
    record_scene(folder, lit_scene, options)
    return folder


@pytest.fixture(scope="module")
def options(sequence, tmp_path_factory) -> RunOptions:
    return RunOptions(sequence, tmp_path_factory.mktemp("run") / "out", device="cpu")


@pytest.fixture(scope="module")
def metrics(options):
    return run_sequence(options)


def test_every_frame_is_tracked_to_millimetres(metrics):
    assert metrics["tracked"] == metrics["frames"] == NUM_FRAMES
    assert metrics["ate_final_rmse_m"] < 0.005


def test_the_map_looks_like_the_room(metrics):
    assert metrics["heldout"]["psnr_db"] > 20
    assert metrics["novel"]["seen"] > 0.2


def test_metrics_json_has_every_key_of_the_contract(metrics, options):
    written = json.loads(RunFolder(options.out).metrics.read_text())

    assert written == metrics
    assert CONTRACT.keys() <= written.keys()
    for key, below in CONTRACT.items():
        assert not below or set(below) <= written[key].keys()


def leaves(value):
    if isinstance(value, dict):
        return [leaf for part in value.values() for leaf in leaves(part)]
    return [value]


def test_metrics_are_numbers_or_null_but_for_names_and_versions(metrics):
    figures = {k: v for k, v in metrics.items() if k not in WORDS}

    assert all(v is None or isinstance(v, int | float) for v in leaves(figures))
    assert all(isinstance(metrics[key], str) for key in ("sequence", "mode"))


def test_a_run_of_14_frames_has_every_figure_but_lpips_and_rpe30(metrics):
    contract = {k: metrics[k] for k in CONTRACT if k not in WORDS}
    missing = {k for k, v in contract.items() if not isinstance(v, dict) and v is None}
    missing |= {f"{k}.{p}" for k, parts in CONTRACT.items() for p in parts if metrics[k][p] is None}

    lpips = {f"{block}.lpips" for block in ("all", "heldout", "novel", "gsicp")}
    assert missing == lpips | {"rpe30_trans_m", "rpe30_rot_deg"}


def test_all_outputs_are_written(metrics, options):
    folder = RunFolder(options.out)
    frames = folder.trajectory("online").read_text().splitlines()

    assert len(frames) == 1 + NUM_FRAMES and frames[2].startswith("0.033333 ")
    assert folder.ply.read_bytes().startswith(b"ply\nformat binary_little_endian")
    assert list(folder.map.glob("*/session.msgpack"))
    assert len(list(folder.renders.glob("*.png"))) == 4
    assert "<h1>PointSLAM++: room</h1>" in folder.report.read_text()


def test_a_finished_run_scores_the_same_again(metrics, options):
    again = evaluate_run(options.out)

    for key in ("ate_final_rmse_m", "all", "heldout", "novel"):
        assert again[key] == metrics[key]


def test_a_run_is_exported_from_its_folder(metrics, options, tmp_path):
    target = tmp_path / "trajectory.txt"

    code = main(["export", str(options.out), "--format", "tum", "--out", str(target)])

    assert code == 0
    assert target.read_text() == RunFolder(options.out).trajectory("final").read_text()


def test_an_export_without_a_target_has_the_name_of_the_folder(metrics, options, monkeypatch):
    monkeypatch.chdir(options.out)

    code = main(["export", ".", "--format", "tum"])

    assert code == 0
    assert (options.out / f"{options.out.name}.txt").is_file()


def test_no_run_needs_ground_truth(sequence, services, tmp_path):
    untrue = tmp_path / "untrue"
    shutil.copytree(sequence, untrue)
    (untrue / "groundtruth.txt").unlink()
    options = RunOptions(untrue, tmp_path / "out", gateway=services.url, max_frames=4)

    metrics = run_sequence(options)

    assert metrics["tracked"] == 4
    assert metrics["ate_final_rmse_m"] is None
    assert metrics["novel"]["psnr_db"] is None
    assert metrics["all"]["psnr_db"] > 20
    assert metrics["peak_rss_mb"] == {"gateway": None, "tracking": None, "mapping": None}


def test_live_mode_answers_every_frame_that_it_keeps(sequence, services, tmp_path):
    options = RunOptions(sequence, tmp_path / "out", mode="live", gateway=services.url)

    metrics = run_sequence(options)

    assert metrics["frames"] == NUM_FRAMES
    assert 1 <= metrics["tracked"] <= NUM_FRAMES and metrics["lost"] == 0


def test_a_damaged_frame_ends_the_run_with_its_name(sequence, services, tmp_path, capsys):
    damaged = tmp_path / "damaged"
    shutil.copytree(sequence, damaged)
    image = damaged / "rgb" / "0.066667.jpg"
    image.write_bytes(image.read_bytes()[:5000])

    words = ["run", str(damaged), "--out", str(tmp_path / "out"), "--gateway", services.url]
    code = main(words)

    assert code == 2
    assert "damaged, frame 2, stamp 0.066667: rgb.bytes: a truncated" in capsys.readouterr().err


def test_a_service_that_cannot_start_is_shown_with_its_log(options, tmp_path, capsys):
    words = ["run", str(options.sequence), "--out", str(tmp_path), "--set", "tracking.wings=2"]

    code = main(words)

    assert code == 2
    assert "unknown setting wings" in capsys.readouterr().err


def test_offline_runs_of_a_seed_are_the_same(options, metrics, services, tmp_path):
    again = replace(options, out=tmp_path / "out", gateway=services.url)

    run_sequence(again)

    for kind in ("online", "final"):
        first, second = (RunFolder(o.out).trajectory(kind) for o in (options, again))
        assert first.read_text() == second.read_text()


WORDS = ("sequence", "mode", "versions", "git_commit")
IMAGES = ("psnr_db", "ssim", "lpips", "depth_l1_m")
CONTRACT: dict[str, tuple[str, ...]] = {
    "all": IMAGES,
    "heldout": IMAGES,
    "novel": (*IMAGES, "psnr_seen_db", "seen"),
    "gsicp": ("psnr_db", "ssim", "lpips"),
    "tracking_ms": ("median", "p95", "stages"),
    "mapping_ms_per_iteration": ("median", "stages"),
    "wall_s": ("tracking", "mapping", "refinement", "total"),
    "anchors": ("primary", "secondary"),
    "peak_rss_mb": ("gateway", "tracking", "mapping"),
} | dict.fromkeys(
    [
        *("sequence", "mode", "frames", "tracked", "lost", "relocalized", "keyframes", "loops"),
        *("ate_online_rmse_m", "ate_final_rmse_m", "ate_online_mean_m", "ate_final_mean_m"),
        *("rpe30_trans_m", "rpe30_rot_deg", "mapping_iterations", "input_fps", "map_mb"),
        *("versions", "git_commit", "seed"),
    ],
    (),
)
