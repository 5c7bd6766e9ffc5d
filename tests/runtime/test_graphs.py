# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import warp as wp

from ggwarp.kernels.losses.rgbd import LOSS_COUNT, add_total
from ggwarp.runtime.graphs import GraphCache


class Work:
    """Adds up a loss; counts how often Python did it."""

    def __init__(self, device: str) -> None:
        self.losses = wp.zeros(LOSS_COUNT, dtype=float, device=device)
        self.weights = wp.full(LOSS_COUNT, 1.0, dtype=float, device=device)
        self.totals = wp.zeros(2, dtype=wp.float64, device=device)
        self.device = wp.get_device(device)
        self.calls: list[bool] = []

    def __call__(self) -> None:
        self.calls.append(bool(self.device.is_capturing))
        add_total(self.losses, weights=self.weights, totals=self.totals, device=self.device)


def test_direct_then_recorded_then_replayed(device):
    work, graphs = Work(device), GraphCache(device)
    for i in range(5):
        work.losses.fill_(float(i))  # replays see what the arrays hold by then
        graphs.run("a", work, arrays=0)
    assert work.totals.numpy().tolist() == [LOSS_COUNT * 10.0, 5.0]
    assert work.calls == [False, True]
    assert not work.device.is_capturing


def test_variants_have_recordings_of_their_own(device):
    one, two, graphs = Work(device), Work(device), GraphCache(device)
    for _ in range(3):
        graphs.run(1, one, arrays=0)
        graphs.run(2, two, arrays=0)
    assert one.totals.numpy()[1] == two.totals.numpy()[1] == 3.0
    assert one.calls == two.calls == [False, True]


def test_new_arrays_are_recorded_anew(device):
    work, graphs = Work(device), GraphCache(device)
    for _ in range(3):
        graphs.run("a", work, arrays=(1, 2))
    before = work.totals
    work.totals = wp.zeros_like(before)
    for _ in range(4):
        graphs.run("a", work, arrays=(1, 3))
    assert (before.numpy()[1], work.totals.numpy()[1]) == (3.0, 4.0)
    assert work.calls == [False, True, False, True]


def test_a_failure_ends_the_recording(device):
    graphs = GraphCache(device)
    work = Work(device)

    def fail() -> None:
        work()
        if wp.get_device(device).is_capturing:
            raise ValueError("no")

    graphs.run("a", fail, arrays=0)
    with pytest.raises(ValueError, match="no"):
        graphs.run("a", fail, arrays=0)
    assert not wp.get_device(device).is_capturing
    graphs.run("b", work, arrays=0)
    np.testing.assert_array_equal(work.totals.numpy(), [0.0, 2.0])
