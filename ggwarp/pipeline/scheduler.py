# SPDX-License-Identifier: Apache-2.0
"""How much mapping each frame gets.

Synchronous: a fixed number of iterations a frame, so that a run repeats to the bit. Live: as
many as fit before the next frame is due.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol


class Scheduler(Protocol):
    """Decides, iteration by iteration, whether the mapper goes on with this frame."""

    def begin_frame(self) -> float:
        """Wait until the frame has arrived; return how late it is taken up, seconds."""
        ...

    def wants_more(self, done: int) -> bool:
        """Return whether another mapping iteration fits after ``done`` of them."""
        ...


class SynchronousScheduler:
    """A fixed number of mapping iterations a frame."""

    def __init__(self, iterations: int) -> None:
        if iterations < 0:
            raise ValueError(f"mapping iterations a frame: {iterations}, but at least 0 is needed")
        self._iterations = iterations

    def begin_frame(self) -> float:
        return 0.0

    def wants_more(self, done: int) -> bool:
        return done < self._iterations


class LiveScheduler:
    """Frames arrive ``fps`` times a second; the mapper works until the next one is due.

    A late frame is still tracked, and gets no mapping until the delay is made up.
    """

    def __init__(
        self,
        fps: float,
        *,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not fps > 0.0:
            raise ValueError(f"frames per second: {fps}, but a positive number is needed")
        self._period = 1.0 / fps
        self._clock = clock
        self._sleep = sleep
        self._start: float | None = None
        self._frames = 0
        self._iteration_s = 0.0
        self._last_check: float | None = None

    def begin_frame(self) -> float:
        now = self._clock()
        if self._start is None:
            self._start = now
        arrival = self._start + self._frames * self._period
        self._frames += 1
        self._last_check = None
        if arrival > now:
            self._sleep(arrival - now)
            return 0.0
        return now - arrival

    def wants_more(self, done: int) -> bool:
        now = self._clock()
        if self._last_check is not None:
            self._iteration_s = now - self._last_check
        self._last_check = now
        assert self._start is not None, "begin_frame comes first"
        due = self._start + self._frames * self._period
        return now + self._iteration_s <= due
