# SPDX-License-Identifier: Apache-2.0
"""What a suite runs: sequences x settings x seeds."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from ggwarp.datasets import BUILT_IN, LIVE
from ggwarp.suite.job import Job, Resources, slug
from ggwarp.suite.run_options import Options, OptionsError, check_options, words

SHIPPED = Path(__file__).parent / "shipped"
"""The suites that come with the package, by their names."""

PUBLISHED = Path(__file__).parent / "reporting" / "published"
"""The published rows that come with the package, by their names."""

METRICS = ("psnr", "ssim", "lpips", "ate_rmse_cm", "depth_l1_cm", "miou", "fps")
"""The figures of a suite that names none."""


class SuiteError(ValueError):
    """A suite cannot be run: one line with the file, the key and the remedy."""


@dataclass(frozen=True)
class Sequence:
    """A recording of a suite.

    Attributes:
        name: in the tables.
        seq: what ``--seq`` gets.
        options: of its runs.
    """

    name: str
    seq: str
    options: Options = field(default_factory=dict)


@dataclass(frozen=True)
class Setting:
    """Options that a suite compares with others, under a name."""

    name: str
    options: Options = field(default_factory=dict)


@dataclass(frozen=True)
class Choice:
    """How one setting is chosen from all."""

    within_db: float = 0.5
    """The fastest is taken whose PSNR is less than this below the best."""


@dataclass(frozen=True)
class Suite:
    """Sequences x settings x seeds.

    Attributes:
        name: of its file.
        title: of its tables.
        sequences, settings, seeds: every combination is a run.
        options: of every run; a sequence's and then a setting's own come before them.
        metrics: names of ``metrics.json`` that the tables show.
        published: name of the published rows to show beside; empty: none.
        fetch: a command that brings a sequence that is not under the data root: ``{seq}`` is its name, and
            ``{folder}`` the empty folder to fill.
        resources: what one run is given.
        choice: how a setting is chosen at the end; None: none is.
    """

    name: str
    sequences: tuple[Sequence, ...]
    settings: tuple[Setting, ...] = (Setting("defaults"),)
    seeds: tuple[int, ...] = (0,)
    title: str = ""
    options: Options = field(default_factory=dict)
    metrics: tuple[str, ...] = METRICS
    published: str = ""
    fetch: str = ""
    resources: Resources = field(default_factory=Resources)
    choice: Choice | None = None

    def jobs(self) -> list[Job]:
        """Return the runs, seed by seed, so that tables without their spread are whole first."""
        every = itertools.product(self.seeds, self.settings, self.sequences)
        return [self._job(sequence, setting, seed) for seed, setting, sequence in every]

    def of_sequences(self, seqs: list[str]) -> Suite:
        """Return the suite with these sequences instead of its own."""
        return dataclasses.replace(self, sequences=tuple(Sequence(seq, seq) for seq in seqs))

    def check(self) -> None:
        """Refuse what no run would take.

        Raises:
            SuiteError: names the section, the option and the remedy.
        """
        try:
            check_options(self.options)
        except OptionsError as error:
            raise SuiteError(f"[options]: {error}") from None
        for kind, parts in (("sequences", self.sequences), ("settings", self.settings)):
            _check_folders(parts)
            for part in parts:
                try:
                    if part.options:
                        check_options(self.options | part.options)
                except OptionsError as error:
                    raise SuiteError(f"[{kind}.{part.name}]: {error}") from None
        if self.choice is not None and not 0.0 <= self.choice.within_db < math.inf:
            raise SuiteError(f"within {self.choice.within_db:g} dB: give a number of dB, 0 or more")
        for sequence in self.sequences:
            if sequence.seq == "-" or sequence.seq.startswith(LIVE):
                raise SuiteError(f"{sequence.seq}: live frames come once; name a recording")

    def _job(self, sequence: Sequence, setting: Setting, seed: int) -> Job:
        options: Options = self.options | sequence.options | setting.options | {"mapper.seed": seed}
        if sequence.seq in BUILT_IN:
            options["built-in.seed"] = seed
        return Job(
            sequence.name, setting.name, seed, sequence.seq, words(options), self.resources, self.fetch
        )


def _check_folders(parts: Iterable[Sequence | Setting]) -> None:
    taken: dict[str, str] = {}
    for part in parts:
        folder = slug(part.name).lower()
        if folder in taken:
            raise SuiteError(f"{taken[folder]} and {part.name} would share a folder; rename one of them")
        taken[folder] = part.name
