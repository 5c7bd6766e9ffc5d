# SPDX-License-Identifier: Apache-2.0
"""Splitting CPU launches: every item once, whoever takes it, from however many callers at once."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.kernels.registration import gicp
from ggwarp.runtime.launch import (
    _cut,
    cpu_thread_limit,
    cpu_threads,
    in_turn,
    launch_split,
    prepared,
    prepared_split,
    set_cpu_threads,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _count_up(offset: int, addend: int, out: wp.array[int]):
    i = offset + wp.tid()
    out[i] = out[i] + i + addend


@pytest.fixture
def three_threads():
    before = cpu_threads()
    set_cpu_threads(3)
    yield
    set_cpu_threads(before)


def counted(count, *, addend=0, device="cpu", min_piece=1):
    """[count] int: each item's number plus ``addend``, added as often as the item was taken."""
    out = wp.zeros(count, dtype=int, device=device)
    launch_split(_count_up, count, inputs=[addend], outputs=[out], device=device, min_piece=min_piece)
    return out.numpy()


class Elsewhere:
    """A device that is no CPU."""

    is_cpu = is_capturing = False


@pytest.mark.parametrize("kernel", [_count_up, gicp._linearise])
def test_on_a_gpu_blocks_are_those_that_the_module_is_compiled_for(monkeypatch, kernel):
    launches = []
    monkeypatch.setattr(wp, "get_device", lambda device: device)
    monkeypatch.setattr(wp, "launch", lambda kernel, **options: launches.append(options["block_dim"]))
    launch_split(kernel, 100, inputs=[], device=Elsewhere())
    assert launches == [kernel.module.options["block_dim"]]
    assert gicp._linearise.module.options["block_dim"] == 64


@given(count=st.integers(1, 10**6), threads=st.integers(2, 9), min_piece=st.integers(1, 500))
def test_pieces_tile_the_range(count, threads, min_piece):
    pieces = _cut(count, threads, min_piece)
    ends = np.cumsum([size for _, size in pieces])
    assert ends[-1] == count
    assert [begin for begin, _ in pieces] == [0, *ends[:-1]]
    assert min(size for _, size in pieces) >= min(min_piece, count)
    assert len(pieces) < 25 * threads


@settings(max_examples=30)
@given(count=st.integers(0, 3000), min_piece=st.integers(1, 100))
def test_every_item_is_taken_once(count, min_piece):
    before = cpu_threads()
    set_cpu_threads(3)
    assert np.array_equal(counted(count, min_piece=min_piece), np.arange(count))
    set_cpu_threads(before)


def test_a_prepared_launch_is_done_as_often_as_it_is_called(three_threads):
    """Whole and in pieces."""
    out = wp.zeros(1000, dtype=int, device="cpu")
    more = {"outputs": [out], "device": "cpu"}
    whole = prepared(_count_up, 1000, inputs=[0, 3], **more)
    for work in (whole, prepared_split(_count_up, 1000, inputs=[3], min_piece=10, **more)):
        out.zero_()
        for times in (1, 2, 3):
            work()
            assert np.array_equal(out.numpy(), times * (np.arange(1000) + 3))
    prepared_split(_count_up, 0, inputs=[3], **more)()
    assert np.array_equal(out.numpy(), 3 * (np.arange(1000) + 3))


def test_work_is_done_in_turn():
    done = []
    work = in_turn(lambda: done.append(1), lambda: done.append(2))
    work()
    work()
    assert done == [1, 2, 1, 2]


def test_callers_may_launch_at_once(three_threads):
    def caller(number):
        return all((counted(500, addend=number) == np.arange(500) + number).all() for _ in range(50))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(caller, range(4)))


def test_a_limit_is_its_thread_s_own(three_threads):
    seen = []
    with cpu_thread_limit(1):
        thread = threading.Thread(target=lambda: seen.append(cpu_threads()))
        thread.start()
        thread.join()
        assert cpu_threads() == 1
        with cpu_thread_limit(2):
            assert cpu_threads() == 2
        assert cpu_threads() == 1
        assert np.array_equal(counted(300), np.arange(300))
    assert cpu_threads() == 3 and seen == [3]
    with cpu_thread_limit(8):
        assert cpu_threads() == 3


def test_a_recorded_launch_is_whole(three_threads):
    out = wp.zeros(1000, dtype=int, device="cpu")
    with wp.ScopedCapture(device="cpu") as capture:
        launch_split(_count_up, 1000, inputs=[0], outputs=[out], device="cpu", min_piece=1)
    recorded = out.numpy().copy()
    wp.capture_launch(capture.graph)
    assert np.array_equal(out.numpy() - recorded, np.arange(1000))


def test_mistakes_reach_the_caller(three_threads):
    with pytest.raises(ValueError, match="at least 1"):
        set_cpu_threads(0)
    with pytest.raises(ValueError, match="at least 1"), cpu_thread_limit(0):
        pass
    with pytest.raises(RuntimeError, match="passed 2 arguments"):
        launch_split(_count_up, 1000, inputs=[0], device="cpu", min_piece=1)
