# SPDX-License-Identifier: Apache-2.0
"""Two threads on one device."""

import contextlib
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import warp as wp

from ggwarp.runtime.stream_scopes import FairLock, StreamLane, stepped_out, two_lanes
from ggwarp.runtime.streams import to_host


def test_whoever_waits_is_next() -> None:
    lock = FairLock()
    order: list[str] = []

    def other() -> None:
        with lock:
            order.append("other")

    thread = threading.Thread(target=other)
    with lock:
        thread.start()
        while not lock.awaited:
            time.sleep(1e-3)
    with lock:  # at once: a plain lock would be had again before the other thread has woken up
        order.append("first")
    thread.join()
    assert order == ["other", "first"]


def test_an_error_leaves_the_lock_free() -> None:
    lock = FairLock()
    with pytest.raises(ZeroDivisionError), lock:
        raise ZeroDivisionError
    with lock:
        assert not lock.awaited


class Streams:
    """Stands in for a device's current stream, which a real one needs CUDA for."""

    def __init__(self) -> None:
        self.current = "own"

    @contextlib.contextmanager
    def scope(self, stream: str, sync_enter: bool) -> Iterator[None]:
        before, self.current = self.current, stream
        yield
        self.current = before


@pytest.fixture
def streams(monkeypatch: pytest.MonkeyPatch) -> Streams:
    streams = Streams()
    monkeypatch.setattr(wp, "ScopedStream", streams.scope)
    return streams


def test_who_waits_lets_the_other_in_and_comes_back_to_its_own_stream(streams: Streams) -> None:
    lock = FairLock()
    one, other = StreamLane("one", lock), StreamLane("other", lock)
    seen: list[str] = []

    def visit() -> None:
        with other:
            seen.append(streams.current)

    thread = threading.Thread(target=visit)
    with one:
        thread.start()
        with stepped_out():
            thread.join(10.0)
            assert seen == ["other"] and streams.current == "own"
        assert streams.current == "one"
        with pytest.raises(ZeroDivisionError), stepped_out():
            raise ZeroDivisionError
        assert streams.current == "one"
    assert streams.current == "own" and not lock.awaited
    with stepped_out():  # in no lane there is none to leave
        assert streams.current == "own"


def test_each_lane_sees_its_own_work_and_the_device_sees_both(device: str) -> None:
    before = wp.full(1000, 1.0, dtype=float, device=device)
    sums: dict[str, list[float]] = {}
    arrays: dict[str, wp.array] = {}

    def work(name: str, lane: object, value: float) -> None:
        sums[name] = []
        for step in range(20):
            with lane:  # pyright: ignore[reportGeneralTypeIssues]
                arrays[name] = wp.clone(before)
                arrays[name].fill_(value * step)
                sums[name].append(float(to_host(arrays[name]).sum()))

    with two_lanes(device) as (one, other):
        thread = threading.Thread(target=work, args=("one", one, 1.0))
        thread.start()
        work("other", other, -1.0)
        thread.join()
    assert sums["one"] == [1000.0 * step for step in range(20)]
    assert sums["other"] == [-1000.0 * step for step in range(20)]
    np.testing.assert_array_equal(arrays["one"].numpy(), 19.0)
    np.testing.assert_array_equal(arrays["other"].numpy(), -19.0)
