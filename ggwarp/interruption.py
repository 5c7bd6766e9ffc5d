# SPDX-License-Identifier: Apache-2.0
"""How the command hears Ctrl-C, and that it is to end: a run stops after its step, and is saved."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time

TYPE_CHECKING = False  # not typing's, which takes as long to import as all else that comes before a handler
if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType, TracebackType
    from typing import Any

_PATIENCE = 5.0
"""Seconds after the first signal in which another one is taken for the same."""


COMPILER = "ggwarp-load"
"""The name of threads that compile."""

_program_ends = False


def end_program_after() -> None:
    """Tell that the program ends when the command has returned.

    Once it was asked to stop, it then hears no signal any more: a second one would change its exit code, or
    cut off its last words.
    """
    global _program_ends
    _program_ends = True


def leave_compilers(code: int) -> None:
    """End the program at once with ``code``, where it is to end and a compiler works in one of its threads.

    Python's own end, with a compiler at work, crashes.
    """
    if _program_ends and any(thread.name == COMPILER for thread in threading.enumerate()):
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)


class Interrupted(KeyboardInterrupt):
    """Raised by a signal. Where KeyboardInterrupt itself has passed, Python may end the program by SIGINT."""


class Interruption:
    """Turns the first SIGINT, SIGTERM or SIGHUP into a request to stop after the current step.

    While :attr:`at_once` holds, as long as there is nothing to save, it raises KeyboardInterrupt instead. So
    does a later signal in a block that is :meth:`breakable`, for a step that does not end.

    Attributes:
        number: the first signal's; None: none came.
        at_once: whether the first signal raises.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.at_once = True
        self._asked_at = 0.0
        self._breakable = False
        self._previous: dict[int, Any] = {}

    @property
    def requested(self) -> bool:
        """Whether to stop."""
        return self.number is not None

    @property
    def exit_code(self) -> int:
        """The exit code of a program that the signal ended: 130, 143 or 129."""
        return 128 + (self.number or signal.SIGINT)

    def forget(self) -> None:
        """Take the request as done."""
        self.number = None

    @contextlib.contextmanager
    def breakable(self) -> Iterator[None]:
        """Let a later signal end the block: what was done before it is kept by the caller."""
        self._breakable = True
        try:
            yield
        finally:
            self._breakable = False

    def __enter__(self) -> Interruption:
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)
            # nohup has SIGHUP ignored, and means it.
            if number is None or (name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN):
                continue
            try:
                self._previous[number] = signal.signal(number, self._request)
            except ValueError:  # not the main thread: signals are the caller's business
                break
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, previous in self._previous.items():
            if signal.getsignal(number) != self._request:  # one within has heard the program's last
                continue
            if _program_ends:  # and says no more, not even where it was interrupted
                previous = signal.SIG_IGN if self.requested else signal.SIG_DFL
            signal.signal(number, previous or signal.SIG_DFL)
        self._previous.clear()

    def _request(self, number: int, frame: FrameType | None) -> None:
        first = self.number is None
        if first:
            self.number, self._asked_at = number, time.monotonic()
        late = time.monotonic() - self._asked_at > _PATIENCE
        # A second one at once would break off what the first has begun: tidying up.
        if (self.at_once and (first or late)) or (late and self._breakable):
            raise Interrupted
