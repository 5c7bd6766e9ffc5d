# SPDX-License-Identifier: Apache-2.0
"""How far an edit is, for those who wait for it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

Progress = Callable[[str, float], None]
"""Told what is being done, and what share of the whole is done, 0..1."""

_INTERVAL = 5.0
"""Seconds between lines where there is no terminal."""


def silent(what: str, share: float) -> None:
    """Tell nobody."""


def part_of(progress: Progress, start: float, end: float) -> Progress:
    """Return the progress of a part that takes ``progress`` from ``start`` to ``end``."""
    return lambda what, share: progress(what, start + (end - start) * share)


@contextmanager
def open_progress() -> Iterator[Progress]:
    """Show progress on standard error: a live line on a terminal, elsewhere a line every few seconds."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines(console)
        return
    columns = TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn()
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, share: bar.update(task, description=what, completed=share)


class _Lines:
    """Progress as lines, the first after a few seconds."""

    def __init__(self, console: Console) -> None:
        self._console, self._said = console, time.monotonic()

    def __call__(self, what: str, share: float) -> None:
        now = time.monotonic()
        if now - self._said >= _INTERVAL:
            self._said = now
            self._console.print(f"{what}: {100.0 * share:.0f} %", markup=False, highlight=False)
