"""What cannot be started is refused before anything is."""

from pathlib import Path

import pytest

from pointslam.launcher import LaunchOptions
from shared.errors import ConfigError


@pytest.mark.parametrize(
    "change", [{"num_trackers": 0}, {"num_mappers": 0}, {"http_port": 99999}, {"grpc_port": -1}]
)
def test_impossible_services_are_refused(change):
    with pytest.raises(ConfigError):
        LaunchOptions(Path("data"), Path("logs"), **change)
