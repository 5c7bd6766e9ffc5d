# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from ggwarp.viewer.worker import Worker


@pytest.fixture
def worker() -> Iterator[Worker]:
    made = Worker()
    yield made
    made.end()


def _never(error: Exception) -> None:
    raise AssertionError(error)


def test_tasks_are_done_in_turn_and_the_newest_of_a_key(worker):
    done: list[str] = []
    gate, begun = threading.Event(), threading.Event()

    def first() -> None:
        begun.set()
        gate.wait(10.0)
        done.append("first")

    worker.do(first, _never)
    assert begun.wait(10.0) and worker.is_busy
    for k in range(3):
        worker.do(lambda k=k: done.append(f"slider {k}"), _never, key="slider")
    worker.do(lambda: done.append("last"), _never)
    gate.set()
    assert worker.wait(10.0) and not worker.is_busy
    assert done == ["first", "slider 2", "last"]


def test_a_failure_is_told_and_the_next_task_is_done(worker):
    told: list[Exception] = []
    done: list[int] = []

    def fails() -> None:
        raise ValueError("no")

    worker.do(fails, told.append)
    worker.do(lambda: done.append(1), _never)
    assert worker.wait(10.0)
    assert [str(e) for e in told] == ["no"] and done == [1]


def test_what_is_done_between_makes_way(worker):
    order: list[str] = []
    begun, more = threading.Event(), threading.Event()

    def steps() -> Iterator[None]:
        for k in range(3):
            order.append(f"step {k}")
            begun.set()
            assert more.wait(10.0)
            yield

    worker.do_between(steps())
    assert begun.wait(10.0) and not worker.is_busy
    worker.do(lambda: order.append("task"), _never)
    more.set()
    assert worker.wait(10.0)
    assert order == ["step 0", "task", "step 1", "step 2"]
