# SPDX-License-Identifier: Apache-2.0
"""One thread that does all that the page asks for, in turn."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

log = logging.getLogger(__name__)


@dataclass
class _Task:
    work: Callable[[], None]
    failed: Callable[[Exception], None]
    key: str


class Worker:
    """Does tasks one after another in a thread of its own, so that nothing they share needs a lock."""

    def __init__(self, name: str = "ggwarp-viewer") -> None:
        self._tasks: deque[_Task] = deque()
        self._idle: deque[Iterator[None]] = deque()
        self._changed = threading.Condition()
        self._ended = self._working = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        """Whether something is being done or waits."""
        with self._changed:
            return self._working or bool(self._tasks)

    def do(self, work: Callable[[], None], failed: Callable[[Exception], None], *, key: str = "") -> None:
        """Have ``work`` done, and ``failed`` called with what it raises.

        Args:
            key: of tasks of which only the newest matters, such as a slider's: it takes the place of the one
                that waits.
        """
        with self._changed:
            if key:
                waiting = [task for task in self._tasks if task.key != key]
                self._tasks.clear()
                self._tasks.extend(waiting)
            self._tasks.append(_Task(work, failed, key))
            self._changed.notify_all()

    def do_between(self, steps: Iterator[None]) -> None:
        """Have ``steps`` taken, one at a time, whenever nothing else waits; they do not count as busy."""
        with self._changed:
            self._idle.append(steps)
            self._changed.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until nothing at all is left to do; False: it took longer than ``timeout`` seconds."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not self._working and not self._tasks and not self._idle, timeout
            )

    def end(self) -> None:
        """Drop what waits, and end the thread once what it does is done."""
        with self._changed:
            self._ended = True
            self._tasks.clear()
            self._idle.clear()
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._working = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._tasks or self._idle or self._ended)
                if self._ended:
                    return
                task = self._tasks.popleft() if self._tasks else None
                steps = self._idle[0] if task is None else None
                self._working = task is not None
            if task is not None:
                try:
                    task.work()
                except Exception as error:
                    task.failed(error)
            elif steps is not None:
                self._step(steps)

    def _step(self, steps: Iterator[None]) -> None:
        try:
            next(steps)
            return
        except StopIteration:
            pass
        except Exception as error:  # what is done in between is never needed
            log.error("the viewer failed", exc_info=error)
        with self._changed:
            if self._idle and self._idle[0] is steps:
                self._idle.popleft()
            self._changed.notify_all()
