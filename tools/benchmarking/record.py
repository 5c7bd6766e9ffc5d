# SPDX-License-Identifier: Apache-2.0
"""A benchmark's results: rows, checks against targets, and what they were measured on; as JSON."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

Row = dict[str, Any]
"""Column -> number, text or None (not measured); the column's name has its unit."""


@dataclass(frozen=True)
class Check:
    """A figure beside its target.

    Attributes:
        name: what it is.
        value: as measured; None: not measured.
        relation: how it must stand to ``target``.
        note: what else to know, such as why it was not measured.
    """

    name: str
    value: float | None
    relation: Literal["<=", ">="]
    target: float
    unit: str = ""
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None where nothing was measured."""
        if self.value is None or not math.isfinite(self.value):
            return None
        return self.value <= self.target if self.relation == "<=" else self.value >= self.target


@dataclass(frozen=True)
class Section:
    """A table.

    Attributes:
        title: what it shows.
        rows: all with the same columns, in their order.
        note: what is held fixed, what is counted.
    """

    title: str
    rows: list[Row]
    note: str = ""


@dataclass
class Record:
    """The outcome of one subcommand.

    Attributes:
        benchmark: the subcommand.
        machine: see :func:`benchmarking.machine.describe`.
        settings: its options.
        checks, sections: the results.
        notes: what was not run, and why.
    """

    benchmark: str
    machine: dict[str, Any]
    settings: dict[str, Any]
    checks: list[Check] = field(default_factory=list)
    sections: list[Section] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def section(self, title: str) -> Section | None:
        """Return the section of that title, if it is there."""
        return next((s for s in self.sections if s.title == title), None)


def settings_of(options: Any) -> dict[str, Any]:
    """Return a dataclass of options as plain values."""
    return {name: _plain(value) for name, value in dataclasses.asdict(options).items()}


def write_record(path: Path, record: Record) -> None:
    """Write ``record`` as JSON; what is not finite becomes null."""
    content = dataclasses.asdict(record)
    for check, plain in zip(record.checks, content["checks"], strict=True):
        plain["met"] = check.met
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_plain(content), indent=1) + "\n")


def read_record(path: Path) -> Record:
    """Read what :func:`write_record` wrote."""
    content = json.loads(path.read_text())
    for check in content["checks"]:
        del check["met"]
    content["checks"] = [Check(**check) for check in content["checks"]]
    content["sections"] = [Section(**section) for section in content["sections"]]
    return Record(**content)


def _plain(value: Any) -> Any:
    """Return ``value`` in JSON's terms."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item"):  # a NumPy scalar
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
