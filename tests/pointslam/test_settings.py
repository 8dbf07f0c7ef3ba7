"""Settings find their service; the command line refuses in one line."""

from __future__ import annotations

import pytest

from pointslam.cli import main
from pointslam.run import RunOptions
from pointslam.settings import read_settings
from shared.errors import ConfigError


def test_a_word_goes_to_the_service_that_it_names():
    settings = read_settings(None, ["tracking.gicp.voxel_size_m=0.1", "mapping.lr=1e-3"])

    assert settings.services.arguments("tracking") == ["--set", "gicp.voxel_size_m=0.1"]
    assert settings.services.arguments("gateway") == []


def test_words_override_the_file(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("mapping:\n  window: 5\n  loss: {ssim: 0.2}\nsequence: {depth_scale: 5208}\n")

    settings = read_settings(file, ["mapping.window=7"])

    words = settings.services.arguments("mapping")
    assert words == ["--set", "window=7", "--set", "loss.ssim=0.2"]
    assert settings.sequence.depth_scale == 5208


def test_settings_survive_as_words():
    services = read_settings(None, ["mapping.name='a b'", "tracking.on=true"]).services

    assert read_settings(None, services.words()).services == services


@pytest.mark.parametrize("word", ["speed=1", "mapping=3", "sequence.depth=2"])
def test_settings_that_nobody_has_are_refused(word):
    with pytest.raises(ConfigError):
        read_settings(None, [word])


@pytest.mark.parametrize(
    "wrong",
    [
        {"mode": "fast"},
        {"holdout": 1},
        {"max_frames": 0},
        {"refine": -1},
        {"mode": "live", "speed": 0.0},
        {"mode": "live", "speed": float("nan")},
        {"mode": "offline", "speed": 2.0},
    ],
)
def test_impossible_runs_are_refused(tmp_path, wrong):
    with pytest.raises(ConfigError):
        RunOptions(sequence=tmp_path, out=tmp_path, **wrong)


@pytest.mark.parametrize(
    "words",
    [
        ["run", "nowhere", "--out", "out"],
        ["run", ".", "--out", "out", "--set", "speed=1"],
        ["evaluate", "nowhere"],
        ["synth", "room", "--frames", "1"],
        ["export", "nothing", "--gateway", "http://127.0.0.1:9"],
        ["export", "nothing", "--gateway", "http://127.0.0.1:80a"],
        ["export", "nothing", "--gateway", "127.0.0.1:8080"],
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)

    code = main(words)

    error = capsys.readouterr().err
    assert code == 2
    assert error.startswith("error: ") and error.count("\n") == 1
