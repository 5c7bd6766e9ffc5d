# SPDX-License-Identifier: Apache-2.0
"""When frames arrive, and how much mapping each of them gets.

Synchronous: a fixed number of iterations a frame, so that a run repeats to the bit. Live: frames arrive by
the clock, and the mapper works until the next one is due. Uncapped: frames arrive as fast as they are
tracked, and the mapper has the time that tracking leaves it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from ggwarp.runtime.state import state_value

Waiting = Callable[[], bool]
"""Says whether another tracked frame waits for the mapper, or none will come any more."""


@state_value
@dataclass(frozen=True)
class Arrival:
    """How a frame was taken up.

    Attributes:
        delay: seconds from its arrival to its being taken up.
        late: whether the frame before was still being worked on when it arrived.
        behind: newer frames that had arrived by then.
    """

    delay: float = 0.0
    late: bool = False
    behind: int = 0


class Scheduler(Protocol):
    """Has one method for either side; they may be called from two threads."""

    def wait_for_frame(self) -> Arrival:
        """Wait until the next frame has arrived (the tracker's side)."""
        ...

    def should_continue(self, done: int, waiting: Waiting | None) -> bool:
        """Return whether the mapper goes on with a frame after ``done`` iterations (the mapper's side).

        Args:
            waiting: asks for the next frame where tracking runs beside; None: in turn.
        """
        ...


class SynchronousScheduler:
    """A fixed number of mapping iterations a frame."""

    def __init__(self, iterations: int) -> None:
        if iterations < 0:
            raise ValueError(f"mapping iterations a frame: {iterations}, but at least 0 is needed")
        self._iterations = iterations

    def wait_for_frame(self) -> Arrival:
        return Arrival()

    def should_continue(self, done: int, waiting: Waiting | None) -> bool:
        return done < self._iterations


class UncappedScheduler:
    """Frames are there whenever the tracker is.

    Beside the tracker, the mapper works on a frame until the next one waits; in turn it does ``minimum``.
    """

    def __init__(self, minimum: int = 1) -> None:
        """``minimum``: iterations that every frame gets, so that new Gaussians are fitted at all."""
        self._minimum = minimum

    def wait_for_frame(self) -> Arrival:
        return Arrival()

    def should_continue(self, done: int, waiting: Waiting | None) -> bool:
        return done < self._minimum or (waiting is not None and not waiting())


class LiveScheduler:
    """Frames arrive ``fps`` times a second; the mapper works until the next one is due.

    A late frame is still tracked; there is no mapping until the delay is made up.
    """

    def __init__(
        self,
        fps: float,
        *,
        frames: int | None = None,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """``frames``: after so many no more arrive; None: they never end."""
        if not fps > 0.0:
            raise ValueError(f"frames per second: {fps}, but a positive number is needed")
        self._period = 1.0 / fps
        self._clock = clock
        self._sleep = sleep
        self._total = math.inf if frames is None else frames
        self._start: float | None = None
        self._frames = 0
        self._late = False
        self._iteration_s = 0.0
        self._last_check: float | None = None

    def wait_for_frame(self) -> Arrival:
        now = self._clock()
        if self._start is None:
            self._start = now
        arrival = self._start + self._frames * self._period
        self._frames += 1
        self._last_check = None
        self._late = now > arrival
        if now < arrival:
            self._sleep(arrival - now)
            now = self._clock()
        delay = max(0.0, now - arrival)
        behind = min(int(delay / self._period), max(0, self._total - self._frames))
        return Arrival(delay, self._late, int(behind))

    def should_continue(self, done: int, waiting: Waiting | None) -> bool:
        if waiting is not None:
            # Mapping takes computing time from a tracker that is late: none of it until that has caught up.
            return not self._late and not waiting()
        now = self._clock()
        if self._last_check is not None:
            self._iteration_s = now - self._last_check
        self._last_check = now
        assert self._start is not None, "wait_for_frame comes first"
        due = self._start + self._frames * self._period
        return now + self._iteration_s <= due
