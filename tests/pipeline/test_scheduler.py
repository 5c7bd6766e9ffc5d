# SPDX-License-Identifier: Apache-2.0
import pytest

from ggwarp.pipeline.scheduler import Arrival, LiveScheduler, SynchronousScheduler, UncappedScheduler


class FakeTime:
    """A clock that moves only when told; a sleep takes ``oversleep`` longer than asked."""

    def __init__(self) -> None:
        self.now = 0.0
        self.oversleep = 0.0

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds + self.oversleep


@pytest.fixture
def time() -> FakeTime:
    return FakeTime()


@pytest.fixture
def live(time: FakeTime) -> LiveScheduler:
    return LiveScheduler(10.0, clock=time.clock, sleep=time.sleep)


def test_synchronous_mapping_is_a_fixed_number() -> None:
    scheduler = SynchronousScheduler(3)
    assert scheduler.wait_for_frame() == Arrival()
    for waiting in (None, lambda: True, lambda: False):
        assert [scheduler.should_continue(i, waiting) for i in range(5)] == [True, True, True, False, False]


def test_uncapped_mapping_is_a_minimum_and_the_time_tracking_takes() -> None:
    scheduler = UncappedScheduler(minimum=2)
    assert scheduler.wait_for_frame() == Arrival()
    assert [scheduler.should_continue(i, None) for i in range(4)] == [True, True, False, False]
    assert [scheduler.should_continue(i, lambda: True) for i in range(4)] == [True, True, False, False]
    assert all(scheduler.should_continue(i, lambda: False) for i in range(100))


def test_live_mapping_fills_the_time_to_the_next_frame(time: FakeTime, live: LiveScheduler) -> None:
    live.wait_for_frame()
    done = 0
    while live.should_continue(done, None):
        time.now += 0.03
        done += 1
    assert done == 3, "a fourth iteration would end at 0.12 s, after the next frame is due"
    assert live.wait_for_frame() == Arrival()
    assert time.now == pytest.approx(0.1), "an early system waits for the frame"


def test_a_late_frame_gets_no_mapping_and_says_how_late(time: FakeTime, live: LiveScheduler) -> None:
    live.wait_for_frame()
    time.now = 0.35
    arrival = live.wait_for_frame()
    assert arrival.late and arrival.delay == pytest.approx(0.25)
    assert arrival.behind == 2, "those of 0.2 and 0.3 s have arrived, too"
    assert not live.should_continue(0, None)


def test_no_more_frames_wait_than_there_are(time: FakeTime) -> None:
    live = LiveScheduler(10.0, frames=3, clock=time.clock, sleep=time.sleep)
    live.wait_for_frame()
    time.now = 5.0
    assert [live.wait_for_frame().behind for _ in range(3)] == [1, 0, 0]


def test_beside_the_tracker_mapping_goes_on_until_the_next_frame_waits(
    time: FakeTime, live: LiveScheduler
) -> None:
    live.wait_for_frame()
    time.now = 0.09
    live.wait_for_frame()
    assert live.should_continue(7, lambda: False), (
        "the clock alone does not end it: that pose is not there yet"
    )
    assert not live.should_continue(7, lambda: True)


def test_beside_a_late_tracker_there_is_no_mapping_until_it_has_caught_up(
    time: FakeTime, live: LiveScheduler
) -> None:
    live.wait_for_frame()
    time.now = 0.15
    assert live.wait_for_frame().late
    assert not live.should_continue(0, lambda: False)
    time.now = 0.19
    assert not live.wait_for_frame().late
    assert live.should_continue(0, lambda: False)


def test_a_tracker_that_waits_is_not_late_however_long_the_system_sleeps(
    time: FakeTime, live: LiveScheduler
) -> None:
    live.wait_for_frame()
    time.oversleep = 0.004
    arrival = live.wait_for_frame()
    assert not arrival.late and arrival.behind == 0
    assert arrival.delay == pytest.approx(0.004), "but the time counts towards the latency"


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan")])
def test_impossible_rates_are_refused(fps: float) -> None:
    with pytest.raises(ValueError, match="frames per second"):
        LiveScheduler(fps)
