# SPDX-License-Identifier: Apache-2.0
"""The tables as files: ``suite.csv``, ``suite.md`` and ``suite.tex``."""

from __future__ import annotations

import re
from pathlib import Path

from ggwarp.io.atomic import atomic_write
from ggwarp.io.printable import printable
from ggwarp.io.table import write_table
from ggwarp.suite.reporting.published import load_published
from ggwarp.suite.reporting.rows import Row, State, metric_of, paper_rows, shown
from ggwarp.suite.results import Results

RUN_COLUMNS = ("sequence", "setting", "seed", "status", "reason", "attempts", "wall_s", "cpu_s", "folder")


def write_csv(results: Results, path: Path) -> None:
    """Write a row a run, with all that it measured.

    Raises:
        OSError: it cannot be written.
    """
    metrics = sorted({name for run in results.runs for name in run.metrics} - set(RUN_COLUMNS))
    rows = [{**run.metrics, **{name: getattr(run, name) for name in RUN_COLUMNS}} for run in results.runs]
    write_table(path, (*RUN_COLUMNS, *metrics), rows)


def write_markdown(results: Results, path: Path) -> None:
    """Write the papers' table, and what is not done.

    Raises:
        OSError: it cannot be written.
    """
    _write_text(path, markdown(results))


def write_latex(results: Results, path: Path) -> None:
    """Write the papers' table as a ``tabular`` for ``booktabs``.

    Raises:
        OSError: it cannot be written.
    """
    _write_text(path, latex(results))


def markdown(results: Results) -> str:
    """Return the papers' table, and what is not done, in Markdown."""
    lines = [f"# {_cell(results.title)}", "", *markdown_table(results), "", note(results)]
    undone = [run for run in results.runs if run.status != "done" and run.reason]
    if undone:
        lines += ["", "## Not done", "", "| run | | why |", "|---|---|---|"]
        lines += [f"| {_cell(run.label)} | {run.status} | {_cell(run.reason)} |" for run in undone]
    return "\n".join(lines) + "\n"


def markdown_table(results: Results) -> list[str]:
    """Return the lines of the papers' table."""
    lines = [
        f"| | | {' | '.join(map(_cell, results.sequences))} | Avg. |",
        f"|---|---|{'--:|' * (len(results.sequences) + 1)}",
    ]
    before = ""
    for row in paper_rows(results):
        system = _cell(titled(row)) if titled(row) != before else ""
        before = titled(row)
        cells = [shown(cell, row.metric) for cell in (*row.cells, row.average)]
        lines.append(f"| {system} | {metric_of(row.metric).header} | {' | '.join(cells)} |")
    return lines


def latex(results: Results) -> str:
    """Return the papers' table as a LaTeX ``tabular``."""
    columns = "ll" + "r" * (len(results.sequences) + 1)
    heads = " & ".join(_tex(name) for name in (*results.sequences, "Avg."))
    lines = [
        *(f"% {line}" for line in (printable(results.title), note(results))),
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        rf"Method & Metric & {heads} \\",
    ]
    before = ""
    for row in paper_rows(results):
        if titled(row) != before:
            lines.append(r"\midrule")
        name = _tex(titled(row)) if titled(row) != before else ""
        before = titled(row)
        metric = metric_of(row.metric)
        arrow = {1: r" $\uparrow$", -1: r" $\downarrow$", 0: ""}[metric.better]
        cells = " & ".join(
            "--" if cell is State.NOT_MEASURED else shown(cell, row.metric).replace(" ± ", r" $\pm$ ")
            for cell in (*row.cells, row.average)
        )
        lines.append(rf"{name} & {_tex(metric.name)}{arrow} & {cells} \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def titled(row: Row) -> str:
    """Return what a table calls the row's system."""
    return f"{row.system} ({row.source})" if row.source else row.system


def note(results: Results) -> str:
    """Return what a reader of the tables must know, in a sentence or two."""
    seeds = len({run.seed for run in results.runs})
    parts = [f"ggwarp {results.version}: {results.count('done')} of {len(results.runs)} runs are done."]
    if seeds > 1:
        parts.append(f"Mean and standard deviation over {seeds} seeds.")
    if results.published:
        parts.append(f"Published rows: {load_published(results.published).source}.")
    return printable(" ".join(parts))


def _write_text(path: Path, text: str) -> None:
    with atomic_write(path) as file:
        file.write(text.encode(errors="replace"))


def _cell(text: str) -> str:
    return printable(text).replace("|", "\\|")


_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}


def _tex(text: str) -> str:
    return re.sub(r"[\\~^&%$#_{}]", lambda found: _TEX.get(found[0], "\\" + found[0]), printable(text))
