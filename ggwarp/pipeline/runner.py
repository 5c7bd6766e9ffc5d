# SPDX-License-Identifier: Apache-2.0
"""The loop over the frames: tracking and mapping in turn, or beside each other in two threads.

Tracking of the next frame needs nothing of the mapping of this one, as long as the tracker does not look at
the Gaussians. Its side may then run a few frames ahead: each side still sees the same frames in the same
order, so that the results of synchronous mode stay the same to the bit.

It does not always pay. On two CPU cores kernels already use both, and 82-91 % of the computing time is
theirs: at best a frame takes 6-13 % less time, and its pose comes twice as late. Where frames do not wait for
the mapper (``--fps uncapped``) it is what gives the mapper its time.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Generic, TypeVar

from ggwarp.pipeline.scheduler import Waiting
from ggwarp.pipeline.slam import Slam
from ggwarp.pipeline.tracked_frame import TrackedFrame
from ggwarp.runtime.state import State
from ggwarp.types import Frame, StepReport

T = TypeVar("T")

AHEAD = 3
"""TrackedFrame frames that may wait for the mapper."""


_PATIENCE, _INTERVAL = 4.0, 0.1
"""Seconds that a thread may take to end, and after which one who waits for it looks again."""


@dataclass
class Snapshot:
    """Both sides of the system after the same frame, as :meth:`ggwarp.pipeline.slam.Slam.restore` takes them.

    The tracker's side adds its own when one is due, and the mapper's when that frame's turn has come: neither
    waits for the other.

    Attributes:
        pending: frames between the two: tracked, but not mapped, as the run was stopped.
        failure: why a side could not give its state, such as for want of memory. The run itself goes on.
    """

    tracking: State = field(default_factory=dict)
    mapping: State = field(default_factory=dict)
    pending: list[TrackedFrame] = field(default_factory=list)
    failure: Exception | None = None

    def take_tracking(self, slam: Slam) -> Snapshot:
        """Add the tracker's side."""
        try:
            self.tracking = slam.tracking_state()
        except Exception as error:
            self.failure = error
        return self

    def take_mapping(self, slam: Slam) -> Snapshot:
        """Add the mapper's side."""
        try:
            self.mapping = slam.mapping_state()
        except Exception as error:
            self.failure = error
        return self


class SideError(RuntimeError):
    """One side of the system failed: reading, tracking or mapping; ``__cause__`` has the reason."""

    def __init__(self, side: str, where: str) -> None:
        super().__init__(f"{side} failed {where}")


def run_steps(
    slam: Slam,
    items: Iterable[Any],
    *,
    concurrent: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    snapshot_due: Callable[[], bool] = lambda: False,
    pending: Iterable[TrackedFrame] = (),
) -> Iterator[tuple[Any, StepReport | None]]:
    """Process the frames among ``items``; yield every item in order, each frame with its report.

    Where one is due, a :class:`Snapshot` is yielded after the frame that it is of; and where the tracker was
    ahead when it was stopped, one in the end.

    Args:
        items: frames, and anything else in place of a frame that is missing.
        concurrent: track in a second thread, up to :data:`AHEAD` frames ahead of the mapper.
        stopped: asked between frames whether to end early.
        snapshot_due: asked between frames by the tracker's side.
        pending: tracked before, to be mapped first.

    Raises:
        SideError: one side failed; both have ended. Every tracked frame was yielded before.
        ValueError: ``concurrent``, but tracking looks at the Gaussians being mapped.
    """
    halted = threading.Event()
    source = _tracked(slam, items, lambda: halted.is_set() or stopped(), snapshot_due)
    failure: SideError | None = None
    unmapped: Snapshot | None = None
    with contextlib.ExitStack() as stack:
        waiting = None
        if concurrent:
            stack.enter_context(slam.in_two_threads())
            source = stack.enter_context(_Ahead(source, AHEAD, halted, stopped))
            waiting = source.waiting
        try:
            for item, tracked in itertools.chain(((t.frame, t) for t in pending), source):
                if isinstance(item, Snapshot):
                    if failure is None and slam.has_state:
                        yield item.take_mapping(slam), None
                    continue
                if tracked is None:
                    yield item, None
                    continue
                if failure is not None or (concurrent and stopped()):
                    if unmapped is None and failure is None and slam.has_state:
                        unmapped = Snapshot().take_mapping(slam)
                    if unmapped is not None:
                        unmapped.pending.append(tracked)
                    report = slam.leave_unmapped(tracked)
                else:
                    report, failure = _mapped(slam, tracked, waiting)
                    if failure is not None:
                        halted.set()
                yield item, report
        except SideError as error:
            failure = failure or error
    if failure is not None:
        raise failure
    if unmapped is not None and isinstance(source, _Ahead) and source.is_complete:
        yield unmapped.take_tracking(slam), None


def _mapped(
    slam: Slam, tracked: TrackedFrame, waiting: Waiting | None
) -> tuple[StepReport, SideError | None]:
    """The mapper's side: return the frame's report, and what went wrong."""
    try:
        return slam.map_frame(tracked, waiting), None
    except Exception as error:
        failure = SideError("mapping", f"at frame {tracked.frame.index}")
        failure.__cause__ = error
        return slam.leave_unmapped(tracked), failure


def _tracked(
    slam: Slam, items: Iterable[Any], stopped: Callable[[], bool], snapshot_due: Callable[[], bool]
) -> Iterator[tuple[Any, TrackedFrame | None]]:
    """The tracker's side: yield every item, frames with their pose, and its half of snapshots."""
    last = None
    remaining = iter(items)
    while not stopped():
        if snapshot_due() and last is not None:
            yield Snapshot().take_tracking(slam), None
        try:
            item = next(remaining, None)
        except Exception as error:
            where = "at the first frame" if last is None else f"after frame {last}"
            raise SideError("reading", where) from error
        if item is None:
            # That there are no more is seen when the next one fails to arrive.
            slam.skip_frame()
            return
        last = item.index
        if not isinstance(item, Frame):
            slam.skip_frame()
            yield item, None
            continue
        try:
            tracked = slam.track_frame(item)
        except Exception as error:
            raise SideError("tracking", f"at frame {item.index}") from error
        yield item, tracked


class _Ahead(Generic[T]):
    """Runs an iterator in a thread of its own, a few items ahead.

    Attributes:
        is_complete: whether the iterator has come to its end.
    """

    def __init__(
        self, source: Iterator[T], ahead: int, halted: threading.Event, stopped: Callable[[], bool]
    ) -> None:
        """``halted`` is set to end ``source``, which asks for it; so does it for ``stopped``."""
        self._source = source
        self._halted, self._stopped = halted, stopped
        self._queue: queue.Queue[tuple[T] | BaseException | None] = queue.Queue(ahead)
        self._thread = threading.Thread(target=self._run, name="ggwarp-tracking", daemon=True)
        self._ended = False
        self.is_complete = False

    def waiting(self) -> bool:
        """Return whether there is something to take without waiting: an item, or the end."""
        return not self._queue.empty()

    def __enter__(self) -> _Ahead[T]:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._halted.set()
        while not self._ended:  # the thread may be waiting for room
            self._take()
        self._thread.join(_PATIENCE)

    def __iter__(self) -> Iterator[T]:
        while (taken := self._take()) is not None:
            if isinstance(taken, BaseException):
                raise taken
            yield taken[0]

    def _take(self) -> tuple[T] | BaseException | None:
        """Return the next item, or the end: also where a thread that is to end hangs."""
        taken, left = None, _PATIENCE
        while left > 0.0:
            try:
                taken = self._queue.get(timeout=_INTERVAL)
                break
            except queue.Empty:
                if self._halted.is_set() or self._stopped():
                    left -= _INTERVAL
        self._ended = not isinstance(taken, tuple)
        return taken

    def _run(self) -> None:
        end = None
        try:
            for item in self._source:
                self._queue.put((item,))
        except BaseException as error:  # handed to the other side, which would else wait for ever
            end = error
        self.is_complete = end is None
        self._queue.put(end)
