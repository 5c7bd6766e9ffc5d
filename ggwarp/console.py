# SPDX-License-Identifier: Apache-2.0
"""What the command shows: progress, notes, warnings, the closing table.

On a terminal a live progress line and a table; elsewhere plain lines, one every few seconds, and
``key value`` at the end. Results and progress go to standard output, warnings and errors to
standard error.
"""

from __future__ import annotations

import logging
import time
from typing import Any, Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

_log = logging.getLogger(__name__)

_WIDE = 110  # columns from which on there is room for a bar
_PLAIN_INTERVAL = 5.0  # seconds between progress lines where there is no terminal


class Display(Protocol):
    """Shows a run to its user."""

    def note(self, line: str) -> None:
        """Say one thing."""
        ...

    def warn(self, line: str) -> None:
        """Say that something is amiss."""
        ...

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a stage of ``total`` steps (None: unknown), ending the one before."""
        ...

    def advance(self, status: str = "") -> None:
        """Count a step of the stage and show how it stands."""
        ...

    def close(self) -> None:
        """End the progress display; safe to call twice."""
        ...

    def results(self, metrics: dict[str, Any], groups: dict[str, list[str]]) -> None:
        """Show ``metrics``, a table with a section for each of ``groups`` (title -> keys)."""
        ...


def open_display() -> Display:
    """Return the display that suits standard output, and show what the library logs."""
    console = Console()
    log = logging.getLogger("ggwarp")
    log.handlers = [_LogHandler(console, Console(stderr=True))]
    log.setLevel(logging.INFO)
    return TerminalDisplay(console) if console.is_terminal else PlainDisplay()


class _LogHandler(logging.Handler):
    """Shows warnings on standard error and the rest on standard output, a line each."""

    def __init__(self, output: Console, errors: Console) -> None:
        super().__init__()
        self._output, self._errors = output, errors

    def emit(self, record: logging.LogRecord) -> None:
        line = record.getMessage()
        if record.levelno >= logging.WARNING:
            _print(self._errors, f"warning: {line}")
        else:
            _print(self._output, line)


class TerminalDisplay:
    """A live progress line and a table."""

    def __init__(self, console: Console) -> None:
        self._console = console
        # A terminal of 80 columns must have room for a whole status line.
        bar = [BarColumn(bar_width=24)] if console.width >= _WIDE else []
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            *bar,
            TextColumn("{task.fields[count]}"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[status]}"),
            console=console,
            transient=True,
        )
        self._task: Any = None
        self._done, self._total = 0, None

    def note(self, line: str) -> None:
        _print(self._console, line)

    def warn(self, line: str) -> None:
        _log.warning("%s", line)

    def stage(self, name: str, total: int | None = None) -> None:
        self._progress.start()
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._done, self._total = 0, total
        self._task = self._progress.add_task(name, total=total, status="", count="")

    def advance(self, status: str = "") -> None:
        self._done += 1
        self._progress.update(self._task, advance=1, status=status, count=f"{self._done}/{self._total}")

    def close(self) -> None:
        self._progress.stop()

    def results(self, metrics: dict[str, Any], groups: dict[str, list[str]]) -> None:
        table = Table(show_header=False, title=f"{metrics['sequence']} ({metrics['dataset']})")
        table.add_column()
        table.add_column(justify="right")
        for title, keys in groups.items():
            table.add_section()
            table.add_row(f"[bold]{title}", "")
            for key in keys:
                table.add_row(key, _text(metrics[key]))
        self._console.print(table)


class PlainDisplay:
    """Lines of text, for files and pipes."""

    def __init__(self) -> None:
        self._name, self._total, self._done = "", None, 0
        self._started = self._shown = 0.0

    def note(self, line: str) -> None:
        print(line, flush=True)

    def warn(self, line: str) -> None:
        _log.warning("%s", line)

    def stage(self, name: str, total: int | None = None) -> None:
        self._name, self._total, self._done = name, total, 0
        self._started = self._shown = time.monotonic()
        print(name, flush=True)

    def advance(self, status: str = "") -> None:
        self._done += 1
        now = time.monotonic()
        if now - self._shown < _PLAIN_INTERVAL and self._done != self._total:
            return
        self._shown = now
        parts = [f"{self._name}: {self._done}/{self._total}", status]
        if self._total is not None and self._done < self._total:
            parts.append(f"{(now - self._started) / self._done * (self._total - self._done):.0f} s left")
        print(", ".join(p for p in parts if p), flush=True)

    def close(self) -> None:
        pass

    def results(self, metrics: dict[str, Any], groups: dict[str, list[str]]) -> None:
        for key in [k for keys in groups.values() for k in keys]:
            print(f"{key} {_text(metrics[key])}", flush=True)


def _print(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1.0 else f"{value:.2f}"
    return f"{value:,}" if isinstance(value, int) else str(value)
