# SPDX-License-Identifier: Apache-2.0
"""``index.html``: the tables, and every run with links to what it left; one file, no script, no network."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from urllib.parse import quote

from ggwarp.io.atomic import atomic_write
from ggwarp.io.printable import printable
from ggwarp.suite.reporting.comparison import Comparison
from ggwarp.suite.reporting.rows import State, metric_of, number, paper_rows, shown
from ggwarp.suite.reporting.writers import note, titled
from ggwarp.suite.results import Results, RunResult

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --faint: #8882; --bad: #c0392b; --good: #1e8449; }
@media (prefers-color-scheme: dark) { :root { --bad: #ff8a7a; --good: #7fd6a0; } }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; padding: 0 1rem; max-width: 90rem; }
h1 { margin-bottom: 0; } h2 { margin-top: 2rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .7rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td.why { white-space: normal; text-align: left; min-width: 16rem; }
tr.published { background: var(--faint); }
tr.first td { border-top: 2px solid var(--line); }
.state, .small { opacity: .7; } .failed, .worse { color: var(--bad); } .done, .better { color: var(--good); }
"""


def write_page(results: Results, folder: Path, comparison: Comparison | None = None) -> None:
    """Write ``folder/index.html``; ``folder`` is the suite's.

    Raises:
        OSError: it cannot be written.
    """
    with atomic_write(folder / "index.html") as file:
        file.write(page(results, folder, comparison).encode(errors="replace"))


def page(results: Results, folder: Path, comparison: Comparison | None = None) -> str:
    """Return the page; links are relative to ``folder``."""
    title = _text(results.title)
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{title}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{title}</h1>",
        f"<p>{_text(note(results))}</p>",
        '<p class="small">Also as <a href="suite.csv">CSV</a>, <a href="suite.md">Markdown</a>, '
        '<a href="suite.tex">LaTeX</a> and <a href="suite.json">JSON</a>.</p>',
        *_undone(results),
        "<h2>Figures</h2>",
        *_figures(results),
        *([] if comparison is None else _comparison(comparison)),
        "<h2>Runs</h2>",
        *_runs(results, folder),
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def _undone(results: Results) -> Iterable[str]:
    """Yield what failed, before all else."""
    failed = [run for run in results.runs if run.status == "failed"]
    if failed:
        yield f'<h2 class="failed">{len(failed)} failed</h2><ul>'
        for run in failed:
            yield f"<li>{_text(run.label)}: {_text(run.reason)} ({_log(run)})</li>"
        yield "</ul>"


def _figures(results: Results) -> Iterable[str]:
    heads = "".join(f"<th>{_text(name)}</th>" for name in (*results.sequences, "Avg."))
    yield f'<div class="wide"><table><tr><th></th><th class="text"></th>{heads}</tr>'
    before = ""
    for row in paper_rows(results):
        name = titled(row)
        classes = " ".join(["published"] * bool(row.source) + ["first"] * (name != before))
        cells = "".join(
            f'<td class="{"failed" if cell is State.FAILED else "state" if isinstance(cell, State) else ""}">'
            f"{_text(shown(cell, row.metric))}</td>"
            for cell in (*row.cells, row.average)
        )
        system = _text(name) if name != before else ""
        header = _text(metric_of(row.metric).header)
        yield f'<tr class="{classes}"><td>{system}</td><td class="text">{header}</td>{cells}</tr>'
        before = name
    yield "</table></div>"


def _comparison(comparison: Comparison) -> Iterable[str]:
    yield f"<h2>Against {_text(comparison.earlier)}</h2>"
    yield f"<p>{_text(comparison.note)}</p>"
    yield '<div class="wide"><table><tr><th>setting</th><th class="text">figure</th><th>pairs</th>'
    yield "<th>before</th><th>now</th><th>difference</th><th>p</th><th class='text'></th></tr>"
    for row in comparison.rows:
        digits = metric_of(row.metric).digits + 1
        cells = "".join(f"<td>{value:.{digits}f}</td>" for value in (row.before, row.now))
        yield (
            f'<tr><td>{_text(row.setting)}</td><td class="text">{_text(metric_of(row.metric).header)}</td>'
            f"<td>{row.pairs}</td>{cells}<td>{row.difference:+.{digits}f}</td><td>{row.p_text}</td>"
            f'<td class="text {row.verdict}">{row.verdict}</td></tr>'
        )
    yield "</table></div>"


def _runs(results: Results, folder: Path) -> Iterable[str]:
    heads = "".join(f"<th>{_text(metric_of(name).name)}</th>" for name in results.metrics)
    yield '<div class="wide"><table><tr><th>run</th><th class="text"></th><th>tries</th><th>time [s]</th>'
    yield f'<th>core time [s]</th>{heads}<th class="text">see</th><th class="text"></th></tr>'
    for run in results.runs:
        cells = "".join(
            f"<td>{number(run.metrics[name], name) if name in run.metrics else '-'}</td>"
            for name in results.metrics
        )
        yield (
            f'<tr><td>{_text(run.label)}</td><td class="text {run.status}">{run.status}</td>'
            f"<td>{run.attempts}</td><td>{run.wall_s:.0f}</td><td>{run.cpu_s:.0f}</td>{cells}"
            f'<td class="text">{_links(run, folder)}</td><td class="why">{_text(run.reason)}</td></tr>'
        )
    yield "</table></div>"


def _links(run: RunResult, folder: Path) -> str:
    """Return links to what there is of a run: its report, its folder, its log."""
    links: list[str] = []
    if (folder / run.folder / "report.html").is_file():
        links.append(_link(f"{run.folder}/report.html", "report"))
    if (folder / run.folder).is_dir():
        links.append(_link(f"{run.folder}/", "folder"))
    if run.attempts:
        links.append(_log(run))
    return ", ".join(links)


def _log(run: RunResult) -> str:
    return _link(f"{run.folder}.log", "log")


def _link(target: str, text: str) -> str:
    return f'<a href="{escape(quote(target, errors="replace"))}">{text}</a>'


def _text(text: str) -> str:
    return escape(printable(text))
