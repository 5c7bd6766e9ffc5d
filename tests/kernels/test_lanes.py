# SPDX-License-Identifier: Apache-2.0
"""Two threads on one device."""

import threading
import time

import numpy as np
import pytest
import warp as wp

from ggwarp.kernels.lanes import FairLock, two_lanes
from ggwarp.kernels.streams import to_host


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
