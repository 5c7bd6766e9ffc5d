# SPDX-License-Identifier: Apache-2.0
"""One run of a suite: what it is asked for, and the record of how often it was tried and how that went."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ggwarp.io import guarded
from ggwarp.io.json import write_json

RECORD = guarded.FileKind("a job's record", 1 << 20)


@dataclass(frozen=True)
class Resources:
    """What one run of a suite is given."""

    cpus: int = 1
    """Cores, and the threads that the run uses."""

    gpus: float | None = None
    """GPUs; a part of one is shared. None: one where there is any and the device allows it."""

    memory_gb: float = 2.0
    """Gigabytes of memory that the run is expected to take at most."""


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        sequence, setting: their names in the suite.
        seed: of the run.
        seq: what ``--seq`` gets.
        arguments: all other options of ``ggwarp run``, but ``--out``, ``--data`` and ``--device``.
        resources: what the run is given.
        fetch: the command that brings a sequence that is not there; empty: none.
    """

    sequence: str
    setting: str
    seed: int
    seq: str
    arguments: tuple[str, ...]
    resources: Resources = field(default_factory=Resources)
    fetch: str = ""

    @property
    def name(self) -> str:
        """The path of its run folder under the suite's ``runs/``."""
        return f"{slug(self.sequence)}/{slug(self.setting)}/seed-{self.seed}"

    @property
    def label(self) -> str:
        """How messages call it."""
        return f"{self.sequence}, {self.setting}, seed {self.seed}"


def slug(name: str) -> str:
    """Return ``name`` as the name of a folder."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._") or "_"


@dataclass(frozen=True)
class Attempt:
    """One try of a job.

    Attributes:
        started: UTC, ISO 8601.
        host: the machine.
        resumed: whether it went on from a checkpoint.
        exit_code: of ``ggwarp run``, negative: the signal that killed it; None: not known, it is running or
            its machine was lost.
        wall_s, cpu_s: seconds that passed, and of all cores; None: not known.
        reason: why it failed, in one line; empty: it did not.
    """

    started: str
    host: str
    resumed: bool = False
    exit_code: int | None = None
    wall_s: float | None = None
    cpu_s: float | None = None
    reason: str = ""


@dataclass(frozen=True)
class JobRecord:
    """What became of a job so far: ``runs/NAME.json`` beside its run folder.

    Attributes:
        command: the options that it was run with, ``--out`` aside; another command is another job.
        attempts: the oldest first.
        obstacle: what kept it from being tried, such as absent data; empty: nothing.
    """

    command: tuple[str, ...]
    attempts: tuple[Attempt, ...] = ()
    obstacle: str = ""

    @property
    def status(self) -> str:
        """``done``, ``failed``, or ``not run``: never tried, stopped on its way, or lost with its machine."""
        if not self.attempts or self.obstacle:
            return "not run"
        last = self.attempts[-1]
        if last.exit_code == 0:
            return "done"
        return "not run" if self.was_stopped or not last.reason else "failed"

    @property
    def was_stopped(self) -> bool:
        """Whether somebody stopped the last try, which is nobody's failure."""
        return bool(self.attempts) and self.attempts[-1].exit_code in _STOPPED

    @property
    def reason(self) -> str:
        """Why it is not done; empty: it is, or nobody has tried."""
        return self.obstacle or (self.attempts[-1].reason if self.attempts else "")

    @property
    def cost(self) -> tuple[float, float]:
        """Seconds that all its tries took: passed, and of all cores."""
        return sum(a.wall_s or 0.0 for a in self.attempts), sum(a.cpu_s or 0.0 for a in self.attempts)

    def tried(self, attempt: Attempt) -> JobRecord:
        """Return the record with one try more."""
        return dataclasses.replace(self, attempts=(*self.attempts, attempt), obstacle="")

    def ended(self, **changes: Any) -> JobRecord:
        """Return the record with ``changes`` of the last try."""
        last = dataclasses.replace(self.attempts[-1], **changes)
        return dataclasses.replace(self, attempts=(*self.attempts[:-1], last))

    def write(self, path: Path) -> None:
        """Write it to ``path``, whose folder is made.

        Raises:
            OSError: it cannot be written.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, dataclasses.asdict(self))


_STOPPED = (129, 130, 143, -1, -2, -15)
"""Exit codes of a run that SIGHUP, SIGINT or SIGTERM ended, in its own way or before it could hear them."""


def read_record(path: Path) -> JobRecord | None:
    """Return the record in ``path``; None: there is none that can be read, and the job begins anew."""
    try:
        values = guarded.read_json(path, RECORD)
        attempts = tuple(Attempt(**attempt) for attempt in values["attempts"])
        return JobRecord(tuple(values["command"]), attempts, values["obstacle"])
    except (guarded.FileError, KeyError, TypeError):
        return None
