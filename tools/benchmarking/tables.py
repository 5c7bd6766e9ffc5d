# SPDX-License-Identifier: Apache-2.0
"""A record on the terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarking.record import Check, Record, Section


def show(record: Record, console: Console) -> None:
    """Print ``record``: what it was measured on, its tables, and each check beside its target."""
    m = record.machine
    versions = ", ".join(f"{name} {version}" for name, version in m["versions"].items())
    _say(console, f"{record.benchmark}: {m['device']} ({m['cpu']}, {m['cores']} cores), {m['system']}")
    _say(console, f"{versions}; commit {m['commit']}, {m['date']}")
    for section in record.sections:
        if section.rows:
            console.print(_table(section))
        if section.note:
            _say(console, section.note)
    if record.checks:
        console.print(_checks(record.checks))
    for note in record.notes:
        _say(console, f"note: {note}")


def markdown(record: Record) -> str:
    """Return ``record`` as a page: what it was measured on, its checks and tables."""
    m = record.machine
    versions = ", ".join(f"{name} {version}" for name, version in m["versions"].items())
    lines = [f"# {record.benchmark}: {m['device']}", "", f"Commit {m['commit']}; {versions}."]
    checks = [
        {"check": c.name, "value": c.value, "unit": c.unit, "target": f"{c.relation} {cell(c.target)}"}
        | {"met": "not measured" if c.met is None else cell(c.met)}
        for c in record.checks
    ]
    for section in [Section("against the targets", checks), *record.sections]:
        if section.rows:
            names = list(section.rows[0])
            lines += ["", f"## {section.title}", "", f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"]
            lines += [f"| {' | '.join(cell(row[name]) for name in names)} |" for row in section.rows]
        if section.note:
            lines += ["", f"{section.note[0].upper()}{section.note[1:]}."]
    return "\n".join(lines) + "\n"


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def _table(section: Section) -> Table:
    table = Table(title=section.title, title_justify="left")
    for name, value in section.rows[0].items():
        text = all(isinstance(row.get(name), str) for row in section.rows)
        table.add_column(name, justify="left" if text and isinstance(value, str) else "right")
    for row in section.rows:
        table.add_row(*(cell(row.get(name)) for name in section.rows[0]))
    return table


def _checks(checks: list[Check]) -> Table:
    table = Table(title="against the targets", title_justify="left")
    for name in ("check", "value", "target", "met", "note"):
        table.add_column(name, justify="right" if name in ("value", "target") else "left")
    words = {True: "[green]yes", False: "[red]no", None: "not measured"}
    for c in checks:
        target = f"{c.relation} {cell(c.target)} {c.unit}".rstrip()
        table.add_row(c.name, f"{cell(c.value)} {c.unit}".rstrip(), target, words[c.met], c.note)
    return table


def cell(value: Any) -> str:
    """Return ``value`` as a table shows it: three significant digits at least, - for None."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100.0 else f"{value:,.0f}"
    return str(value)
