# SPDX-License-Identifier: Apache-2.0
"""Reading results, a bounded backlog, and two threads on one device."""

import contextlib
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import warp as wp

from ggwarp.runtime.streams import Backlog, FairLock, StreamScope, outside_scope, stream_scopes, to_host


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64, wp.int32, wp.uint8])
def test_to_host(device, rng, dtype):
    values = (100 * rng.random((7, 5))).astype(wp.dtype_to_numpy(dtype))
    host = to_host(wp.array(values, dtype=dtype, device=device))
    assert host.dtype == values.dtype
    np.testing.assert_array_equal(host, values)


def test_to_host_of_parts_and_vectors(device, rng):
    values = rng.random((9, 3)).astype(np.float32)
    array = wp.array(values, dtype=wp.vec3, device=device)
    np.testing.assert_array_equal(to_host(array[1:8:2]), values[1:8:2])
    assert to_host(array[:0]).shape[0] == 0


def test_a_backlog_lets_work_through(device):
    array = wp.zeros(1, dtype=int, device=device)
    backlog = Backlog(device, limit=2)
    for i in range(7):
        array.fill_(i)
        backlog.added()
    assert to_host(array)[0] == 6


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
    one, other = StreamScope("one", lock), StreamScope("other", lock)
    seen: list[str] = []

    def visit() -> None:
        with other:
            seen.append(streams.current)

    thread = threading.Thread(target=visit)
    with one:
        thread.start()
        with outside_scope():
            thread.join(10.0)
            assert seen == ["other"] and streams.current == "own"
        assert streams.current == "one"
        with pytest.raises(ZeroDivisionError), outside_scope():
            raise ZeroDivisionError
        assert streams.current == "one"
    assert streams.current == "own" and not lock.awaited
    with outside_scope():  # in no scope there is none to leave
        assert streams.current == "own"


def test_each_scope_sees_its_own_work_and_the_device_sees_both(device: str) -> None:
    before = wp.full(1000, 1.0, dtype=float, device=device)
    sums: dict[str, list[float]] = {}
    arrays: dict[str, wp.array] = {}

    def work(name: str, scope: object, value: float) -> None:
        sums[name] = []
        for step in range(20):
            with scope:  # pyright: ignore[reportGeneralTypeIssues]
                arrays[name] = wp.clone(before)
                arrays[name].fill_(value * step)
                sums[name].append(float(to_host(arrays[name]).sum()))

    with stream_scopes(device) as (one, other):
        thread = threading.Thread(target=work, args=("one", one, 1.0))
        thread.start()
        work("other", other, -1.0)
        thread.join()
    assert sums["one"] == [1000.0 * step for step in range(20)]
    assert sums["other"] == [-1000.0 * step for step in range(20)]
    np.testing.assert_array_equal(arrays["one"].numpy(), 19.0)
    np.testing.assert_array_equal(arrays["other"].numpy(), -19.0)
