"""The folder that a run writes into: an earlier run makes room, anything else stays."""

import pytest

from pointslam.run import prepare_folder
from shared.errors import ConfigError


def test_a_folder_of_something_else_is_refused_and_stays_whole(tmp_path):
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "treasure.txt").write_text("here")

    with pytest.raises(ConfigError, match="map/ there is of no run"):
        prepare_folder(tmp_path)

    assert (tmp_path / "map" / "treasure.txt").read_text() == "here"


def test_nothing_of_an_earlier_run_is_left_but_its_logs(tmp_path):
    for name in ("map", "renders", "logs"):
        (tmp_path / name).mkdir()
    for name in ("run.json", "metrics.json", "report.html", "map.ply", "trajectory_final.txt"):
        (tmp_path / name).write_text("old")

    prepare_folder(tmp_path)

    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


def test_a_new_folder_is_made(tmp_path):
    prepare_folder(tmp_path / "some" / "where")

    assert (tmp_path / "some" / "where").is_dir()
