# SPDX-License-Identifier: Apache-2.0
"""What a suite measured: ``suite.json``, and means with their spread over seeds."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import platform
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import ggwarp
from ggwarp.io import guarded
from ggwarp.io.json import write_json
from ggwarp.io.printable import printable
from ggwarp.suite.attempts import Site
from ggwarp.suite.definition import Suite, SuiteError
from ggwarp.suite.job import Job, JobRecord

FORMAT = 1
RESULTS = guarded.FileKind("a suite's results", 1 << 30)
_METRICS = guarded.FileKind("a run's figures", 1 << 22)


@dataclass(frozen=True)
class RunResult:
    """One run of a suite.

    Attributes:
        sequence, setting, seed: which.
        status: ``done``, ``failed`` or ``not run``.
        reason: why it is not done; empty: it is, or nobody has tried.
        folder: of the run, relative to the suite's.
        attempts: how often it was tried.
        wall_s, cpu_s: seconds of all tries: passed, and of all cores.
        metrics: the numbers of its ``metrics.json``; {}: it is not done.
    """

    sequence: str
    setting: str
    seed: int
    status: str
    reason: str = ""
    folder: str = ""
    attempts: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    metrics: dict[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """How messages call it."""
        return f"{self.sequence}, {self.setting}, seed {self.seed}"


@dataclass(frozen=True)
class Mean:
    """A figure over seeds.

    Attributes:
        value: mean.
        spread: sample standard deviation; None: there is one value alone.
        count: of values.
        missing: seeds whose runs have not measured it.
    """

    value: float
    spread: float | None
    count: int
    missing: int = 0


@dataclass(frozen=True)
class Results:
    """What a suite measured.

    Attributes:
        name, title, metrics, published: the suite's.
        sequences, settings: their names, in the order of the tables.
        runs: all runs of the suite, done or not.
        version: of ggwarp.
        machine: where the suite was started, and its load when the results were written, which says what
            figures of speed are worth.
    """

    name: str
    title: str
    metrics: tuple[str, ...]
    sequences: tuple[str, ...]
    settings: tuple[str, ...]
    runs: tuple[RunResult, ...]
    published: str = ""
    version: str = ggwarp.__version__
    machine: dict[str, Any] = field(default_factory=dict)

    def of(self, sequence: str, setting: str) -> list[RunResult]:
        """Return the runs of a cell of the tables, one a seed."""
        return self._cells.get((sequence, setting), [])

    def mean(self, sequence: str, setting: str, metric: str) -> Mean | None:
        """Return a figure of the runs that are done, over seeds; None: none has measured it."""
        runs = self.of(sequence, setting)
        values = [run.metrics[metric] for run in runs if metric in run.metrics]
        if not values:
            return None
        spread = statistics.stdev(values) if len(values) > 1 else None
        return Mean(statistics.fmean(values), spread, len(values), len(runs) - len(values))

    def average(self, setting: str, metric: str) -> float | None:
        """Return the mean over sequences, as papers print it; None: a sequence lacks the figure."""
        means = [self.mean(sequence, setting, metric) for sequence in self.sequences]
        known = [mean.value for mean in means if mean is not None]
        return statistics.fmean(known) if known and len(known) == len(means) else None

    def count(self, status: str) -> int:
        """Return how many runs are ``done``, ``failed`` or ``not run``."""
        return sum(run.status == status for run in self.runs)

    def write(self, path: Path) -> None:
        """Write ``suite.json``.

        Raises:
            OSError: it cannot be written.
        """
        write_json(path, {"format": FORMAT} | dataclasses.asdict(self))

    @functools.cached_property
    def _cells(self) -> dict[tuple[str, str], list[RunResult]]:
        cells: dict[tuple[str, str], list[RunResult]] = {}
        for run in self.runs:
            cells.setdefault((run.sequence, run.setting), []).append(run)
        return cells


def gather(suite: Suite, site: Site, records: Mapping[Job, JobRecord]) -> Results:
    """Return the results of a suite from the records and the run folders in ``site``."""
    return Results(
        name=suite.name,
        title=suite.title or suite.name,
        metrics=suite.metrics,
        sequences=tuple(sequence.name for sequence in suite.sequences),
        settings=tuple(setting.name for setting in suite.settings),
        runs=tuple(_result(site, job, record) for job, record in records.items()),
        published=suite.published,
        machine=_machine(site.device),
    )


def load_results(path: Path) -> Results:
    """Return the results in ``path``: a suite's folder, or its ``suite.json``.

    Raises:
        SuiteError: there are none, or they are not as this version writes them.
    """
    file = path / "suite.json" if path.is_dir() else path
    name = printable(str(file))
    try:
        values = guarded.read_json(file, RESULTS)
    except guarded.FileError as error:
        raise SuiteError(f"{error}; name a suite's folder or its suite.json") from None
    try:
        if values.pop("format") != FORMAT:
            raise SuiteError(f"{name}: is of another version of ggwarp; run the suite anew")
        runs = tuple(RunResult(**run) for run in values.pop("runs"))
        listed = {key: tuple(values.pop(key)) for key in ("metrics", "sequences", "settings")}
        return Results(runs=runs, **listed, **values)
    except (AttributeError, KeyError, TypeError):
        raise SuiteError(f"{name}: is not what ggwarp suite writes; run the suite anew") from None


def _machine(device: str) -> dict[str, Any]:
    found: dict[str, Any] = {"system": platform.platform(), "cores": os.cpu_count(), "device": device}
    with contextlib.suppress(AttributeError, OSError):
        found["load"] = round(os.getloadavg()[0], 1)
    return found


def _result(site: Site, job: Job, record: JobRecord) -> RunResult:
    wall_s, cpu_s = record.cost
    return RunResult(
        job.sequence,
        job.setting,
        job.seed,
        record.status,
        "" if record.status == "done" else record.reason,
        f"runs/{job.name}",
        len(record.attempts),
        wall_s,
        cpu_s,
        _measured(site.run_folder(job)) if record.status == "done" else {},
    )


def _measured(folder: Path) -> dict[str, float]:
    """Return the numbers of a run's ``metrics.json``; what was not measured is left out."""
    with contextlib.suppress(guarded.FileError):
        values = guarded.read_json(folder / "metrics.json", _METRICS)
        numbers = {k: v for k, v in values.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
        return {name: value for name, value in numbers.items() if math.isfinite(value)}
    return {}
