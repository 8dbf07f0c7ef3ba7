"""Which tracking worker gets which session."""

from collections import Counter

from services.gateway.dispatch import choose

WORKERS = [f"tracker-{i}" for i in range(4)]


def assign(sessions, workers, load_cap=1.25):
    loads = dict.fromkeys(workers, 0)
    chosen = {}
    for session in sessions:
        chosen[session] = choose(session, loads, load_cap)
        loads[chosen[session]] += 1
    return chosen


def test_the_choice_is_the_same_wherever_it_is_made():
    loads = dict.fromkeys(WORKERS, 0)

    assert {choose("s", dict(reversed(loads.items())), 1.25) for _ in range(3)} == {
        choose("s", loads, 1.25)
    }


def test_no_worker_gets_more_than_its_share():
    counts = Counter(assign([f"s{i}" for i in range(40)], WORKERS).values())

    assert max(counts.values()) <= 13  # 1.25 x 10, rounded up
    assert len(counts) == 4


def test_a_worker_that_is_full_is_passed_over():
    first = choose("s", dict.fromkeys(WORKERS, 0), 1.25)

    assert choose("s", dict.fromkeys(WORKERS, 0) | {first: 9}, 1.25) != first


def test_a_worker_that_leaves_moves_only_its_own_sessions():
    sessions = [f"s{i}" for i in range(200)]
    before = {s: choose(s, dict.fromkeys(WORKERS, 0), 1.25) for s in sessions}

    after = {s: choose(s, dict.fromkeys(WORKERS[1:], 0), 1.25) for s in sessions}

    assert all(after[s] == before[s] for s in sessions if before[s] != WORKERS[0])


def test_a_single_worker_gets_everything():
    assert set(assign(["a", "b", "c"], ["only"]).values()) == {"only"}
