# SPDX-License-Identifier: Apache-2.0
import pytest

from ggwarp.pipeline.scheduler import LiveScheduler, SynchronousScheduler


class FakeTime:
    """A clock that moves only when told."""

    def __init__(self) -> None:
        self.now = 0.0

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_synchronous_mapping_is_a_fixed_number() -> None:
    scheduler = SynchronousScheduler(3)
    assert scheduler.begin_frame() == 0.0
    assert [scheduler.wants_more(i) for i in range(5)] == [True, True, True, False, False]


def test_live_mapping_fills_the_time_to_the_next_frame() -> None:
    time = FakeTime()
    scheduler = LiveScheduler(10.0, clock=time.clock, sleep=time.sleep)
    scheduler.begin_frame()
    done = 0
    while scheduler.wants_more(done):
        time.now += 0.03
        done += 1
    assert done == 3, "a fourth iteration would end at 0.12 s, after the next frame is due"
    assert scheduler.begin_frame() == 0.0
    assert time.now == pytest.approx(0.1), "an early system waits for the frame"


def test_a_late_frame_gets_no_mapping_and_says_how_late() -> None:
    time = FakeTime()
    scheduler = LiveScheduler(10.0, clock=time.clock, sleep=time.sleep)
    scheduler.begin_frame()
    time.now = 0.25
    assert scheduler.begin_frame() == pytest.approx(0.15)
    assert not scheduler.wants_more(0)


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan")])
def test_impossible_rates_are_refused(fps: float) -> None:
    with pytest.raises(ValueError, match="frames per second"):
        LiveScheduler(fps)
