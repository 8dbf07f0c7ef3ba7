import pytest

from shared.telemetry import StageTimes


def test_the_median_is_over_the_window():
    times = StageTimes(window=3)
    for value in (100.0, 1.0, 2.0, 3.0):
        times.add("orb", value)

    assert times.medians() == {"orb": 2.0}
    assert times.last() == {"orb": 3.0}


def test_a_stage_measures_its_block():
    times = StageTimes()

    with times.stage("decode"):
        pass

    assert times.last()["decode"] == pytest.approx(0.0, abs=50.0)
