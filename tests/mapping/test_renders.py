"""Renders beside the optimisation: always of one consistent map, and kept no longer than said."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.cluster import wait_for
from services.mapping.config import DensificationConfig, MappingConfig, RenderConfig
from services.mapping.pipeline import Mapper, NewKeyframe
from services.mapping.sessions.renders import Renders
from shared.maps import RenderReply, RenderRequest
from shared.tracks import KeyframePoses

CONFIG = MappingConfig(
    densification=DensificationConfig(
        first_iteration=4, grow_interval=3, cull_interval=5, min_visits=1
    )
)


@pytest.fixture
def work(frame, true_pose):
    """Three keyframes with iterations between, growing and culling; calls `after` each step."""

    def run(mapper: Mapper, after) -> None:
        for count in (1, 2, 3):
            seqs = np.arange(count) * 4
            poses = KeyframePoses(count, seqs, np.stack([true_pose(int(s)) for s in seqs]))
            keyframe = NewKeyframe(frame(int(seqs[-1])), poses, np.zeros((0, 3)))
            mapper.insert_keyframe(keyframe)
            after()
            for _ in range(6):
                mapper.iterate()
                after()

    return run


@pytest.fixture
def request_view(true_pose, calibration) -> RenderRequest:
    return RenderRequest(true_pose(2), calibration.colour.intrinsics)


@pytest.fixture
def mapper(calibration) -> Mapper:
    return Mapper(calibration, CONFIG, 0, torch.device("cpu"))


def images(reply: RenderReply) -> list[np.ndarray]:
    return [reply.rgb, reply.depth_m, reply.alpha, reply.confidence]


def test_renders_beside_the_work_are_those_of_the_map_between_its_steps(
    calibration, work, request_view
):
    def work_and_refine(mapper: Mapper, after) -> None:
        work(mapper, after)
        for progress in (0.0, 0.25, 0.5, 0.75):
            mapper.refine(progress)
            mapper.state(mapper.anchors.rows.room())  # of a snapshot
            after()

    alone = Mapper(calibration, CONFIG, 0, torch.device("cpu"))
    expected = {}
    work_and_refine(
        alone, lambda: expected.update({alone.moment: images(alone.render(request_view))})
    )
    busy = Mapper(calibration, CONFIG, 0, torch.device("cpu"))
    is_done, seen = threading.Event(), []

    def watch() -> None:
        while not is_done.is_set():
            seen.append(busy.render_at(request_view))

    def until_one_more_is_seen() -> None:
        before = len(seen)
        wait_for(lambda: len(seen) > before)

    with ThreadPoolExecutor(3) as pool:
        watchers = [pool.submit(watch) for _ in range(3)]
        try:
            work_and_refine(busy, until_one_more_is_seen)
        finally:
            is_done.set()
    for watcher in watchers:
        watcher.result()

    assert len({moment for moment, _ in seen}) > 5
    wrong = [
        moment
        for moment, reply in seen
        if moment in expected and not all(map(np.array_equal, images(reply), expected[moment]))
    ]
    assert (wrong, [m for m, _ in seen if m not in expected and m.iterations]) == ([], [])


def test_a_view_of_an_unchanged_map_is_drawn_once(mapper, work, request_view):
    work(mapper, lambda: None)
    renders = Renders(mapper, 1, RenderConfig())

    first = renders.answer(request_view)

    assert renders.answer(request_view) is first


def test_a_new_keyframe_is_in_the_next_view(mapper, work, request_view):
    renders = Renders(mapper, 1, RenderConfig(max_iterations=1000, max_age_s=1e9))
    seen = []

    work(mapper, lambda: seen.append(renders.answer(request_view).revision))

    assert seen == [1] * 7 + [2] * 7 + [3] * 7


def test_who_has_the_view_of_this_map_gets_no_images(mapper, work, request_view):
    work(mapper, lambda: None)
    renders = Renders(mapper, 1, RenderConfig())
    state = renders.answer(request_view).state

    again = renders.answer(replace(request_view, unless_state=state))
    mapper.iterate(11)
    later = renders.answer(replace(request_view, unless_state=state))

    assert (again.state, again.rgb.size) == (state, 0)
    assert (later.state == state, later.rgb.shape) == (False, (72, 96, 3))


def test_a_view_of_an_empty_map_is_black_and_unknown(mapper, request_view):
    reply = Renders(mapper, 1, RenderConfig()).answer(request_view)

    assert [int(image.max()) for image in images(reply)] == [0, 0, 0, 0]
