"""Files of trajectories, read by evo."""

from __future__ import annotations

import numpy as np
import pytest
from evo.tools import file_interface

from shared import se3
from shared.trajectories import TrajectoryFormat, trajectory_text

POSES = [
    (1_700_000_000_123_456_789 + i * 33_333_333, se3.exp([0.1 * i, 0.2, -0.3, 0.05 * i, 0.4, 2.0]))
    for i in range(5)
]
READERS = {
    TrajectoryFormat.TUM: file_interface.read_tum_trajectory_file,
    TrajectoryFormat.KITTI: file_interface.read_kitti_poses_file,
    TrajectoryFormat.CSV: file_interface.read_euroc_csv_trajectory,
}


@pytest.fixture
def read(tmp_path):
    def read(format: TrajectoryFormat):
        path = tmp_path / "trajectory"
        path.write_text(trajectory_text(POSES, format))
        return READERS[format](str(path))

    return read


@pytest.mark.parametrize("format", TrajectoryFormat)
def test_evo_reads_the_poses(read, format):
    found = read(format)

    np.testing.assert_allclose(found.poses_se3, [T for _, T in POSES], atol=1e-8)


@pytest.mark.parametrize("format", [TrajectoryFormat.TUM, TrajectoryFormat.CSV])
def test_evo_reads_the_stamps(read, format):
    found = read(format)

    np.testing.assert_allclose(found.timestamps, [1e-9 * t_ns for t_ns, _ in POSES], atol=1e-6)


def test_a_trajectory_without_poses_is_a_file_without_poses():
    assert trajectory_text([], TrajectoryFormat.TUM) == ""
