"""What an iteration costs in memory and in work as scenes grow."""

import numpy as np
import pytest

from benchmarks.rasterizer import room
from services.mapping.rasterizer import CpuRasterizer, View
from services.mapping.rasterizer.cpu import Engine
from services.mapping.rasterizer.scratch import MOST_BYTES, MOST_IN_ALL, Scratch
from services.mapping.rasterizer.threads import workers
from shared.camera import Intrinsics

CAMERA = Intrinsics(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
VIEW = View(np.eye(4), CAMERA)


class CountingScratch(Scratch):
    """Notes how many bytes it had to ask the system for."""

    def __init__(self) -> None:
        super().__init__()
        self.new_bytes = 0

    def _take(self, num_bytes):
        known = {id(memory.base) for memory in (*self._free, *self._returned)}
        memory = super()._take(num_bytes)
        if id(memory.base) not in known:
            self.new_bytes += memory.nbytes
        return memory


def iterate(rasterizer, gaussians):
    rendered = rasterizer(gaussians, VIEW)
    rendered.colour.sum().backward()
    for tensor in gaussians.tensors():
        tensor.grad = None


def counting(num_threads=2):
    scratch, rasterizer = CountingScratch(), CpuRasterizer(num_threads)
    rasterizer._engine = Engine(workers(num_threads), scratch)
    return scratch, rasterizer


@pytest.mark.parametrize("count", [20_000, 100_000])
def test_a_pass_takes_at_most_400_bytes_per_gaussian_beside_its_images(count):
    scratch, rasterizer = counting()

    iterate(rasterizer, room(count))

    images = 5 * 4 * CAMERA.width * CAMERA.height
    assert scratch.new_bytes - 1.25 * images < 400 * count


def test_the_next_iterations_ask_the_system_for_no_memory():
    scratch, rasterizer = counting(num_threads=1)  # several borrow in no fixed order
    gaussians = room(20_000)
    iterate(rasterizer, gaussians)
    before = scratch.new_bytes

    for _ in range(5):
        iterate(rasterizer, gaussians)

    assert scratch.new_bytes == before


def test_two_threads_soon_have_all_the_memory_that_any_order_of_theirs_wants():
    scratch, rasterizer = counting()
    gaussians = room(20_000)
    told = [scratch.new_bytes]

    while len(told) < 100 and len(set(told[-6:])) > 1 or len(told) < 6:
        iterate(rasterizer, gaussians)
        told.append(scratch.new_bytes)

    assert len(set(told[-6:])) == 1


def test_what_is_kept_for_the_next_call_is_bounded():
    scratch = Scratch()
    lent = [scratch.borrow(MOST_BYTES // 10, np.uint8) for _ in range(30)]

    lent.clear()

    assert 0.8 * MOST_BYTES < scratch.num_bytes <= MOST_BYTES


def test_nothing_idle_is_kept_beside_as_much_as_all_may_be():
    scratch = Scratch()
    small = [scratch.borrow(1 << 20, np.uint8) for _ in range(30)]
    small.clear()

    large = scratch.borrow(MOST_IN_ALL, np.uint8)

    assert scratch.num_bytes == 0
    assert large.size == MOST_IN_ALL


def test_the_work_grows_no_faster_than_the_scene():
    def pairs(count):
        engine = Engine(workers(1), Scratch())
        lists = engine.prepare(room(count), VIEW).lists
        assert lists is not None
        return len(lists.owners)

    small, large = pairs(5_000), pairs(50_000)

    assert large < 10 * small
