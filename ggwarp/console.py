# SPDX-License-Identifier: Apache-2.0
"""What the command shows: progress, notes, warnings, the closing table.

On a terminal a live progress line and a table; elsewhere plain lines, one every few seconds, and
``key value`` at the end. Results and progress go to standard output, warnings and errors to standard error.
Everything goes through one display, so that a line never tears the progress line. Text from the data is
never taken for markup, and its control characters are shown as escapes.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import sys
import time
from collections.abc import Callable
from enum import Enum
from typing import IO, Any, Protocol, cast

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from ggwarp.io.printable import printable

_WIDE = 110  # columns from which on there is room for a bar
_LOOK = 0.2  # seconds after which one who waits for an answer looks whether to go on
_PLAIN_INTERVAL = 5.0  # seconds between progress lines where there is no terminal
_MOST_WARNINGS = 300  # that are kept


class Verbosity(Enum):
    """How much the command says."""

    QUIET = logging.WARNING
    NORMAL = logging.INFO
    VERBOSE = logging.DEBUG


class Display(Protocol):
    """Shows a run to its user.

    Attributes:
        warnings: what it has warned of, each once, in order; the first few hundred.
    """

    @property
    def warnings(self) -> list[str]: ...

    def note(self, line: str) -> None:
        """Say one thing on the way."""
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

    def ask(self, question: str, stopped: Callable[[], bool]) -> str:
        """Return what the user answers, empty where nobody can be asked, or once ``stopped``."""
        ...

    def conclude(self, line: str) -> None:
        """Say the last thing: how the run ended."""
        ...


def open_display(verbosity: Verbosity = Verbosity.NORMAL) -> Display:
    """Return the display that suits standard output, and let it show what the library logs."""
    output = Console(file=cast(IO[str], _Lasting(sys.stdout)))
    errors = Console(file=cast(IO[str], _Lasting(sys.stderr)))
    display: Display
    if verbosity is Verbosity.QUIET:
        display = QuietDisplay(output, errors)
    elif verbosity is Verbosity.VERBOSE:
        display = PlainDisplay(output, errors, interval=0.0)
    else:
        display = (TerminalDisplay if output.is_terminal else PlainDisplay)(output, errors)
    show_log(display, verbosity)
    return display


def show_log(display: Display, verbosity: Verbosity) -> None:
    """Let ``display`` show what the library logs."""
    log = logging.getLogger("ggwarp")
    log.handlers = [_LogHandler(display)]
    log.setLevel(verbosity.value)


class _LogHandler(logging.Handler):
    """Hands records to the display: warnings as such, the rest as notes."""

    def __init__(self, display: Display) -> None:
        super().__init__()
        self._display = display

    def emit(self, record: logging.LogRecord) -> None:
        show = self._display.warn if record.levelno >= logging.WARNING else self._display.note
        show(record.getMessage())


class _Lasting:
    """A stream that may go away: a closed terminal or pipe ends no run, what is written is then dropped."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError:
            self._drop()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            self._drop()

    def _drop(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            sink = os.open(os.devnull, os.O_WRONLY)
            os.dup2(sink, self._stream.fileno())
            os.close(sink)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class PlainDisplay:
    """Lines of text, for files and pipes."""

    def __init__(self, output: Console, errors: Console, *, interval: float = _PLAIN_INTERVAL) -> None:
        """``interval``: seconds between two lines of progress."""
        self._output, self._errors, self._interval = output, errors, interval
        self._name, self._total, self._done = "", None, 0
        self._started = self._shown = 0.0
        self.warnings: list[str] = []

    def note(self, line: str) -> None:
        _print(self._output, line)

    def warn(self, line: str) -> None:
        if len(self.warnings) < _MOST_WARNINGS and line not in self.warnings:
            self.warnings.append(line)
        _print(self._errors, f"warning: {line}")

    def stage(self, name: str, total: int | None = None) -> None:
        self._name, self._total, self._done = name, total, 0
        self._started = self._shown = time.monotonic()
        self.note(name)

    def advance(self, status: str = "") -> None:
        self._done += 1
        now = time.monotonic()
        if now - self._shown < self._interval and self._done != self._total:
            return
        self._shown = now
        of = "" if self._total is None else f"/{self._total}"
        parts = [f"{self._name}: {self._done}{of}", status]
        if self._total is not None and self._done < self._total:
            parts.append(f"{(now - self._started) / self._done * (self._total - self._done):.0f} s left")
        self.note(", ".join(p for p in parts if p))

    def close(self) -> None:
        pass

    def results(self, metrics: dict[str, Any], groups: dict[str, list[str]]) -> None:
        for key in [k for keys in groups.values() for k in keys]:
            _print(self._output, f"{key} {_text(metrics[key])}")

    def ask(self, question: str, stopped: Callable[[], bool]) -> str:
        return ""

    def conclude(self, line: str) -> None:
        _print(self._output, line)


class QuietDisplay(PlainDisplay):
    """Warnings and the closing lines alone."""

    def note(self, line: str) -> None:
        pass


class TerminalDisplay(PlainDisplay):
    """A live progress line and a table."""

    def __init__(self, output: Console, errors: Console) -> None:
        super().__init__(output, errors)
        # A terminal of 80 columns must have room for a whole status line.
        bar = [BarColumn(bar_width=24)] if output.width >= _WIDE else []
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            *bar,
            TextColumn("{task.fields[count]}", markup=False),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[status]}", markup=False),
            console=output,
            transient=True,
            redirect_stderr=errors.is_terminal,
        )
        self._task: Any = None
        # Beside the live line only the console that draws it can write without tearing it.
        self._errors = output if errors.is_terminal else errors

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

    def ask(self, question: str, stopped: Callable[[], bool]) -> str:
        if sys.stdin is None or not sys.stdin.isatty():
            return ""
        self.close()
        self._output.print(Text(printable(f"{question} ")), end="")
        # Not input(): nobody may be there, and a signal must end the wait.
        while not select.select([sys.stdin], [], [], _LOOK)[0]:
            if stopped():
                self._output.print()
                return ""
        return sys.stdin.readline().strip()

    def results(self, metrics: dict[str, Any], groups: dict[str, list[str]]) -> None:
        title = Text(printable(f"{metrics['sequence']} ({metrics['dataset']})"))
        table = Table(show_header=False, title=title)
        table.add_column()
        table.add_column(justify="right")
        for group, keys in groups.items():
            table.add_section()
            table.add_row(Text(group, style="bold"), "")
            for key in keys:
                table.add_row(key, Text(_text(metrics[key])))
        self._output.print(table)


def _print(console: Console, line: str) -> None:
    console.print(Text(printable(line)), soft_wrap=True)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1.0 else f"{value:.2f}"
    return f"{value:,}" if isinstance(value, int) else str(value)
