# SPDX-License-Identifier: Apache-2.0
"""One console: a warning never tears the progress line, and text from the data is shown as it is."""

from __future__ import annotations

import io
import logging
import re

import pytest
from rich.console import Console

from ggwarp.console import (
    Display,
    PlainDisplay,
    QuietDisplay,
    TerminalDisplay,
    Verbosity,
    open_display,
    show_log,
)

MARKUP = "frame [red]7[/red] of :cat: [/] lost"


def _terminal(stderr_too: bool = True) -> tuple[TerminalDisplay, io.StringIO, io.StringIO]:
    out = io.StringIO()
    errors = out if stderr_too else io.StringIO()
    output = Console(file=out, force_terminal=True, width=100, color_system=None)
    other = Console(file=errors, force_terminal=stderr_too, width=100, color_system=None)
    return TerminalDisplay(output, other), out, errors


def _plain(kind: type[PlainDisplay]) -> tuple[PlainDisplay, io.StringIO, io.StringIO]:
    out, errors = io.StringIO(), io.StringIO()
    return kind(Console(file=out), Console(file=errors)), out, errors


def _screen(written: str) -> list[str]:
    """Return the lines that a terminal shows after ``written``, cursor movements carried out."""
    lines, row, column = [""], 0, 0
    for part in re.findall(r"\x1b\[[0-9;?]*[A-Za-z]|\r|\n|[^\x1b\r\n]+", written):
        if part == "\n":
            row, column = row + 1, 0
            lines += [""] * (row + 1 - len(lines))
        elif part == "\r":
            column = 0
        elif part.startswith("\x1b["):
            if part.endswith("A"):
                row -= int(part[2:-1] or 1)
            elif part.endswith("K"):
                lines[row] = "" if part == "\x1b[2K" else lines[row][:column]
        else:
            lines[row] = lines[row][:column].ljust(column) + part + lines[row][column + len(part) :]
            column += len(part)
    return [line.rstrip() for line in lines]


def _work(display: Display) -> None:
    display.stage("frames", 3)
    display.advance("30 fps")
    display.warn(MARKUP)
    logging.getLogger("ggwarp.somewhere").warning("the masks' %s", "names [b]differ[/b]")
    display.advance("31 fps")


def test_on_a_terminal_a_warning_stands_whole_above_the_progress_line() -> None:
    display, out, _ = _terminal()
    show_log(display, Verbosity.NORMAL)
    _work(display)
    display._progress.refresh()
    shown = [line for line in _screen(out.getvalue()) if line]
    assert shown[:2] == [f"warning: {MARKUP}", "warning: the masks' names [b]differ[/b]"]
    assert len(shown) == 3 and "frames" in shown[2] and "2/3" in shown[2] and "31 fps" in shown[2]
    display.close()
    assert [line for line in _screen(out.getvalue()) if line] == shown[:2], "the progress line goes"


def test_warnings_go_to_a_file_where_standard_error_is_one() -> None:
    display, out, errors = _terminal(stderr_too=False)
    show_log(display, Verbosity.NORMAL)
    _work(display)
    display.close()
    assert errors.getvalue().splitlines() == [f"warning: {MARKUP}", "warning: the masks' names [b]differ[/b]"]
    assert "warning" not in out.getvalue()


def test_elsewhere_lines_are_plain_and_apart() -> None:
    display, out, errors = _plain(PlainDisplay)
    show_log(display, Verbosity.NORMAL)
    _work(display)
    display.advance("32 fps")
    assert errors.getvalue().splitlines()[0] == f"warning: {MARKUP}"
    assert out.getvalue().splitlines() == ["frames", "frames: 3/3, 32 fps"]


def test_quiet_shows_warnings_and_the_closing_lines() -> None:
    display, out, errors = _plain(QuietDisplay)
    show_log(display, Verbosity.QUIET)
    _work(display)
    logging.getLogger("ggwarp.somewhere").info("by the way")
    display.results({"psnr": 30.0}, {"picture": ["psnr"]})
    display.conclude("results in o")
    assert out.getvalue().splitlines() == ["psnr 30.00", "results in o"]
    assert len(errors.getvalue().splitlines()) == 2


def test_the_table_takes_nothing_for_markup() -> None:
    display, out, _ = _terminal()
    metrics = {"sequence": "[red]x[/red]", "dataset": "folder", "alignment": "[i]se3", "psnr": None}
    display.results(metrics, {"[b]group": ["alignment", "psnr"]})
    shown = out.getvalue()
    assert "[red]x[/red] (folder)" in shown and "[i]se3" in shown and "[b]group" in shown


@pytest.mark.parametrize(
    ("verbosity", "lines"),
    [(Verbosity.QUIET, []), (Verbosity.VERBOSE, ["frames", "detail"]), (Verbosity.NORMAL, ["frames"])],
)
def test_verbosity_is_the_log_s_level(verbosity, lines, capsys) -> None:
    display = open_display(verbosity)
    display.stage("frames", 9)
    logging.getLogger("ggwarp.somewhere").debug("detail")
    assert capsys.readouterr().out.splitlines() == lines


def test_verbose_has_a_line_for_every_frame(capsys) -> None:
    display = open_display(Verbosity.VERBOSE)
    display.stage("frames", 9)
    for _ in range(3):
        display.advance("ok")
    assert [line[:11] for line in capsys.readouterr().out.splitlines()[1:]] == [
        "frames: 1/9",
        "frames: 2/9",
        "frames: 3/9",
    ]


@pytest.mark.parametrize("kind", [PlainDisplay, QuietDisplay])
def test_warnings_are_kept_each_once_and_not_without_end(kind: type[PlainDisplay]) -> None:
    display, _, errors = _plain(kind)
    for line in ("a", "b", "a", *map(str, range(1000))):
        display.warn(line)
    assert display.warnings[:3] == ["a", "b", "0"] and len(display.warnings) == 300
    assert errors.getvalue().count("warning: a\n") == 2, "shown as often as it is said"
