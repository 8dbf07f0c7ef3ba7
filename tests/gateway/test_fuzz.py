"""A little of `pointslam bench fuzz`: nonsense at every door is refused and the gateway lives."""

from benchmarks.fuzz import fuzz, problems


def test_nonsense_is_never_the_gateways_fault():
    outcomes = fuzz(inputs=400, seed=1)

    assert problems(outcomes) == []
    assert {name for name, outcome in outcomes.items() if outcome.answers.total() < 300} == set()
