"""How long a drawn view is given again."""

from __future__ import annotations

import numpy as np
import pytest

from services.mapping.config import RenderConfig
from services.mapping.views.render_cache import Moment, RenderCache
from shared.maps import RenderReply

DRAWN = Moment(revision=3, iterations=100)


def reply(side: int = 10) -> RenderReply:
    grey = np.zeros((side, side), np.uint8)
    rgb, depth_m = np.zeros((side, side, 3), np.uint8), np.zeros((side, side), np.float32)
    return RenderReply(3, rgb, depth_m, grey, grey)


@pytest.fixture
def cache() -> RenderCache:
    cache = RenderCache(RenderConfig(cache_mb=1, max_iterations=10, max_age_s=0.5))
    cache.put(b"view", reply(), DRAWN, 50.0)
    return cache


def test_an_unchanged_map_gives_the_same_view_for_ever(cache):
    assert cache.get(b"view", DRAWN, 1e9) is not None


@pytest.mark.parametrize(
    ("now", "now_s", "is_given"),
    [
        (Moment(3, 110), 50.5, True),
        (Moment(3, 111), 50.1, False),
        (Moment(3, 101), 50.6, False),
        (Moment(4, 100), 50.0, False),
        (Moment(3, 99), 50.0, False),
    ],
    ids=["near and recent", "too many steps", "too old", "new keyframe", "steps taken back"],
)
def test_an_optimised_map_gives_it_within_both_limits_only(cache, now, now_s, is_given):
    assert (cache.get(b"view", now, now_s) is not None) == is_given


def test_another_view_is_not_given(cache):
    assert cache.get(b"other", DRAWN, 50.0) is None


def test_the_view_asked_for_longest_ago_makes_room(cache):
    for name in (b"a", b"b", b"c"):  # 282 kB each
        cache.put(name, reply(177), DRAWN, 50.0)
    cache.get(b"a", DRAWN, 50.0)

    cache.put(b"d", reply(177), DRAWN, 50.0)

    kept = [name for name in (b"view", b"a", b"b", b"c", b"d") if cache.get(name, DRAWN, 50.0)]
    assert kept == [b"a", b"c", b"d"]


def test_a_view_larger_than_the_cache_is_not_kept(cache):
    cache.put(b"large", reply(400), DRAWN, 50.0)

    assert cache.get(b"large", DRAWN, 50.0) is None
