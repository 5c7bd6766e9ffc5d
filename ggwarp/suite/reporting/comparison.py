# SPDX-License-Identifier: Apache-2.0
"""Results against earlier ones: what differs, and whether that is more than chance.

The same run (sequence, setting, seed) is a pair. Where nothing has changed but chance, each pair could as
well be the other way round: p is the share of all such turns whose mean difference is as large (a sign-flip
permutation test), and the p of all figures are corrected together (Benjamini and Hochberg).
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.suite.reporting.rows import metric_of
from ggwarp.suite.results import Results

SIGNIFICANT = 0.05
"""The largest share of findings that may be chance."""

_TURNS = 20_000
"""Turns that are drawn where there are more."""


@dataclass(frozen=True)
class Difference:
    """One figure of one setting.

    Attributes:
        setting, metric: which.
        pairs: runs that both have.
        before, now: means over the pairs.
        p: corrected for the number of figures; None: fewer than two pairs.
        verdict: ``better``, ``worse``, ``different`` (of a figure that is neither), ``the same`` (all pairs
            are equal), or ``no difference seen``.
    """

    setting: str
    metric: str
    pairs: int
    before: float
    now: float
    p: float | None
    verdict: str

    @property
    def difference(self) -> float:
        return self.now - self.before

    @property
    def line(self) -> str:
        """All of it, as a line of text."""
        metric = metric_of(self.metric)
        return (
            f"{self.setting}: {metric.name} {self.before:.{metric.digits + 1}f} -> "
            f"{self.now:.{metric.digits + 1}f} (p {self.p_text}, pairs {self.pairs}): {self.verdict}"
        )

    @property
    def p_text(self) -> str:
        """p as it is printed."""
        return "-" if self.p is None else f"{self.p:.2g}"


@dataclass(frozen=True)
class Comparison:
    """All figures of all settings that two results share.

    Attributes:
        earlier: what it is compared with.
        rows: a row a setting and figure.
        note: how to read them.
    """

    earlier: str
    rows: tuple[Difference, ...]
    note: str


def compare(results: Results, earlier: Results, name: str) -> Comparison:
    """Compare ``results`` with ``earlier`` ones, called ``name``, pair by pair."""
    old = {(run.sequence, run.setting, run.seed): run.metrics for run in earlier.runs}
    found: list[tuple[str, str, NDArray[np.float64]]] = []
    for setting in results.settings:
        for metric in results.metrics:
            pairs = [
                (old[key][metric], run.metrics[metric])
                for run in results.runs
                if (key := (run.sequence, run.setting, run.seed)) in old
                and run.setting == setting
                and metric in run.metrics
                and metric in old[key]
            ]
            if pairs:
                found.append((setting, metric, np.array(pairs, np.float64)))
    corrected = _corrected([sign_flip_p(pairs[:, 1] - pairs[:, 0]) for _, _, pairs in found])
    rows = tuple(
        _difference(setting, metric, pairs, p)
        for (setting, metric, pairs), p in zip(found, corrected, strict=True)
    )
    most = max((row.pairs for row in rows), default=0)
    text = (
        f"Pairs are runs of the same sequence, setting and seed. p: a sign-flip permutation test of the mean "
        f"difference, corrected for {len(rows)} figures; a difference counts below {SIGNIFICANT:g}."
    )
    if most and 2.0 ** (1 - most) > SIGNIFICANT:
        text += " Fewer than 6 pairs, as here, are too few for any difference to count."
    return Comparison(name, rows, text)


def sign_flip_p(differences: NDArray[np.float64]) -> float | None:
    """Return the two-sided p of a mean of ``differences`` [n] as far from 0; None: there are fewer than two.

    Exact up to 14 pairs; beyond, 20,000 turns are drawn, always the same.
    """
    if len(differences) < 2:
        return None
    if not differences.any():
        return 1.0
    from scipy.stats import permutation_test

    found = permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        n_resamples=_TURNS,
        rng=np.random.default_rng(0),
    )
    return float(found.pvalue)


def _corrected(values: list[float | None]) -> list[float | None]:
    """Return the p corrected for their number, by Benjamini and Hochberg."""
    from scipy.stats import false_discovery_control

    known = [value for value in values if value is not None]
    if not known:
        return values
    better = iter(false_discovery_control(known).tolist())
    return [None if value is None else next(better) for value in values]


def _difference(setting: str, metric: str, pairs: NDArray[np.float64], p: float | None) -> Difference:
    before, now = (statistics.fmean(column) for column in pairs.T.tolist())
    return Difference(setting, metric, len(pairs), before, now, p, _verdict(metric, pairs, p))


def _verdict(metric: str, pairs: NDArray[np.float64], p: float | None) -> str:
    if (pairs[:, 0] == pairs[:, 1]).all():
        return "the same"
    if p is None or p > SIGNIFICANT:
        return "no difference seen"
    direction = metric_of(metric).better * np.sign((pairs[:, 1] - pairs[:, 0]).mean())
    return {1.0: "better", -1.0: "worse"}.get(float(direction), "different")
