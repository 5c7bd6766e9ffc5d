# SPDX-License-Identifier: Apache-2.0
"""The loop over the frames: what comes out in which order, how it ends, that two threads change nothing."""

from __future__ import annotations

import contextlib
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.pipeline import runner
from ggwarp.pipeline.mapping import optimiser
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.runner import AHEAD, SideError, Snapshot, run_steps
from ggwarp.pipeline.scheduler import UncappedScheduler
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.pipeline.tracking.hybrid import HybridTracker
from ggwarp.types import Frame

BOTH_WAYS = pytest.mark.parametrize("concurrent", [False, True], ids=["in turn", "concurrent"])


def frame(index: int) -> Frame:
    return Frame(index, float(index), np.zeros((1, 1, 3), np.uint8))


class Sides:
    """Stands in for the system: notes what either side does, and fails where told."""

    has_state = True

    def __init__(self, *, fail_tracking: int = -1, fail_mapping: int = -1) -> None:
        self.fail_tracking, self.fail_mapping = fail_tracking, fail_mapping
        self.tracked: list[int] = []
        self.mapped: list[int] = []
        self.skipped = 0
        self.snapshots: list[Snapshot] = []
        self.may_map = threading.Event()
        self.may_map.set()
        self.blocked = threading.Event()

    def track_frame(self, frame: Frame) -> Any:
        if frame.index == self.fail_tracking:
            self.may_map.set()
            raise ZeroDivisionError("tracking broke")
        self.tracked.append(frame.index)
        if len(self.tracked) == len(self.mapped) + AHEAD + 2:
            self.blocked.set()
        return SimpleNamespace(frame=frame)

    def map_frame(self, tracked: Any, waiting: Any) -> str:
        self.may_map.wait()
        if tracked.frame.index == self.fail_mapping:
            raise ZeroDivisionError("mapping broke")
        self.mapped.append(tracked.frame.index)
        return f"mapped {tracked.frame.index}"

    def leave_unmapped(self, tracked: Any) -> str:
        return f"left {tracked.frame.index}"

    def skip_frame(self) -> None:
        self.skipped += 1

    def tracking_state(self) -> Any:
        return list(self.tracked)

    def mapping_state(self) -> Any:
        return list(self.mapped)

    @contextlib.contextmanager
    def in_two_threads(self) -> Any:
        yield


def run(sides: Sides, items: Any, **options: Any) -> tuple[list[tuple[int, Any]], SideError | None]:
    """Return (index, report) of every item, and what ended the run."""
    out: list[tuple[int, Any]] = []
    try:
        for item, report in run_steps(sides, items, **options):  # pyright: ignore[reportArgumentType]
            if isinstance(item, Snapshot):
                sides.snapshots.append(item)
            else:
                out.append((item.index, report))
    except SideError as error:
        return out, error
    finally:
        assert not [t for t in threading.enumerate() if t.name == "ggwarp-tracking"], "the thread has ended"
    return out, None


@BOTH_WAYS
def test_reports_come_in_order_and_missing_frames_keep_their_place(concurrent: bool) -> None:
    sides = Sides()
    items = [frame(0), frame(1), SimpleNamespace(index=2), frame(3)]
    out, failure = run(sides, items, concurrent=concurrent)
    assert failure is None
    assert out == [(0, "mapped 0"), (1, "mapped 1"), (2, None), (3, "mapped 3")]
    assert sides.skipped == 2, "the missing frame's time passes, and that of the one that does not come"


@BOTH_WAYS
def test_a_failed_tracker_ends_both_after_its_last_frame(concurrent: bool) -> None:
    sides = Sides(fail_tracking=2)
    out, failure = run(sides, map(frame, range(6)), concurrent=concurrent)
    assert out == [(0, "mapped 0"), (1, "mapped 1")]
    assert failure is not None and str(failure) == "tracking failed at frame 2"
    assert isinstance(failure.__cause__, ZeroDivisionError)


@BOTH_WAYS
def test_a_failed_mapper_ends_both_and_keeps_every_pose(concurrent: bool) -> None:
    sides = Sides(fail_mapping=1)
    out, failure = run(sides, map(frame, range(20)), concurrent=concurrent)
    assert out[:2] == [(0, "mapped 0"), (1, "left 1")]
    assert [index for index, _ in out] == sides.tracked and len(out) <= 2 + AHEAD + 1
    assert all(report == f"left {index}" for index, report in out[1:])
    assert failure is not None and str(failure) == "mapping failed at frame 1"
    assert isinstance(failure.__cause__, ZeroDivisionError)


def test_the_first_failure_is_the_one_that_is_told() -> None:
    sides = Sides(fail_mapping=0, fail_tracking=1)
    sides.may_map.clear()  # until the tracker has failed, which nobody knows yet
    _, failure = run(sides, map(frame, range(3)), concurrent=True)
    assert failure is not None and str(failure) == "mapping failed at frame 0"


@BOTH_WAYS
def test_an_unreadable_source_ends_both(concurrent: bool) -> None:
    def source() -> Any:
        yield frame(4)
        raise OSError("the disk is gone")

    out, failure = run(Sides(), source(), concurrent=concurrent)
    assert out == [(4, "mapped 4")]
    assert failure is not None and str(failure) == "reading failed after frame 4"


@BOTH_WAYS
def test_a_stop_ends_it_with_every_pose(concurrent: bool) -> None:
    sides = Sides()
    out, failure = run(sides, map(frame, range(20)), concurrent=concurrent, stopped=lambda: 2 in sides.mapped)
    assert failure is None and [index for index, _ in out] == sides.tracked
    assert out[:3] == [(0, "mapped 0"), (1, "mapped 1"), (2, "mapped 2")]
    assert sides.mapped == [0, 1, 2] and len(out) <= 3 + AHEAD + 1


@BOTH_WAYS
def test_a_snapshot_is_of_both_sides_after_the_same_frame(concurrent: bool) -> None:
    sides, asked = Sides(), iter([True, False, False, True, False, True, False, False, False])
    run(sides, map(frame, range(7)), concurrent=concurrent, snapshot_due=lambda: next(asked))
    assert [(s.tracking, s.mapping) for s in sides.snapshots] == [([0, 1, 2],) * 2, ([0, 1, 2, 3, 4],) * 2]
    assert not any(s.pending for s in sides.snapshots)


def test_what_the_tracker_was_ahead_is_mapped_when_the_run_goes_on() -> None:
    sides = Sides()
    sides.may_map.clear()

    def release() -> None:
        assert sides.blocked.wait(10.0)
        sides.may_map.set()

    helper = threading.Thread(target=release)
    helper.start()
    out, _ = run(sides, map(frame, range(50)), concurrent=True, stopped=lambda: 0 in sides.mapped)
    helper.join()
    [snapshot] = sides.snapshots
    assert snapshot.mapping == [0] == sides.mapped and snapshot.tracking == sides.tracked
    assert [t.frame.index for t in snapshot.pending] == sides.tracked[1:] == [i for i, _ in out[1:]]
    again = Sides()
    out, _ = run(again, map(frame, range(7, 9)), pending=snapshot.pending)
    assert again.mapped == [*sides.tracked[1:], 7, 8] == [i for i, _ in out] and again.tracked == [7, 8]


def test_the_tracker_runs_ahead_but_not_far() -> None:
    sides = Sides()
    sides.may_map.clear()
    steps = run_steps(sides, map(frame, range(50)), concurrent=True)  # pyright: ignore[reportArgumentType]

    def release() -> None:
        assert sides.blocked.wait(10.0), "one at the mapper, AHEAD waiting, one in hand"
        sides.may_map.set()

    helper = threading.Thread(target=release)
    helper.start()
    next(steps)
    helper.join()
    assert len(sides.tracked) <= len(sides.mapped) + AHEAD + 2
    steps.close()  # an abandoned loop leaves no thread behind
    assert not [t for t in threading.enumerate() if t.name == "ggwarp-tracking"]
    assert len(sides.tracked) < 50


def test_a_stop_does_not_wait_for_a_side_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "_PATIENCE", 0.3)
    answer, waits = threading.Event(), threading.Event()

    def source() -> Any:
        yield frame(0)
        waits.set()
        answer.wait()

    sides = Sides()
    steps = run_steps(sides, source(), concurrent=True, stopped=waits.is_set)  # pyright: ignore[reportArgumentType]
    assert [item.index for item, _ in steps] == [0]
    answer.set()
    for thread in threading.enumerate():
        if thread.name == "ggwarp-tracking":
            thread.join()


OFFICE = SyntheticOffice(scale=0.15)


@pytest.fixture(autouse=True)
def prune_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimiser, "_PRUNE_INTERVAL", 3)


def office_run(device: str, *, concurrent: bool, scheduler: Any = None) -> Slam:
    config = SlamConfig(mapper=MapperConfig(iterations=2))
    slam = Slam(config, OFFICE.camera, OFFICE.camera, device=device, scheduler=scheduler)
    for _ in run_steps(slam, (OFFICE[i] for i in range(0, 24, 4)), concurrent=concurrent):
        pass
    return slam


def test_beside_is_in_turn_to_the_bit(device: str) -> None:
    one, other = (office_run(device, concurrent=concurrent) for concurrent in (False, True))
    assert one.keyframe_indices == other.keyframe_indices and len(one.keyframe_indices) >= 2
    assert one.counts == other.counts
    for a, b in zip(one.reports, other.reports, strict=True):
        assert (a.T_wc == b.T_wc).all()
        for name in ("index", "keyframe", "overlap", "gaussians", "loss", "mapping_iterations"):
            assert getattr(a, name) == getattr(b, name), name
    for name, values in one.map_arrays().arrays().items():
        np.testing.assert_array_equal(values, getattr(other.map_arrays(), name), err_msg=name)


def test_a_tracker_that_sees_the_gaussians_works_in_turn(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HybridTracker, "needs_gaussians", True)
    with pytest.raises(ValueError, match="in turn"):
        office_run(device, concurrent=True)
    assert len(office_run(device, concurrent=False).reports) == 6


def test_uncapped_every_frame_is_fitted(device: str) -> None:
    slam = office_run(device, concurrent=True, scheduler=UncappedScheduler())
    assert all(r.mapping_iterations >= 1 for r in slam.reports)
