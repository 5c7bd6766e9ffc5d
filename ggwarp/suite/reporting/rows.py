# SPDX-License-Identifier: Apache-2.0
"""The rows of the papers' tables: a system and a figure a row, a sequence a column, and their average."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from ggwarp.suite.reporting.published import load_published
from ggwarp.suite.results import Mean, Results


class State(Enum):
    """Why a cell has no figure."""

    NOT_RUN = "not run"
    FAILED = "failed"
    NOT_MEASURED = "-"


Cell = Mean | State


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        system: a setting of ours, or a published system.
        metric: name in ``metrics.json``.
        cells: one a sequence.
        average: over sequences; NOT_MEASURED: a sequence is missing.
        source: where it is published; empty: it was measured here.
    """

    system: str
    metric: str
    cells: tuple[Cell, ...]
    average: Cell
    source: str = ""


@dataclass(frozen=True)
class Metric:
    """How a figure is printed.

    Attributes:
        name: as papers call it.
        digits: after the point.
        better: 1: more is better; -1: less is; 0: neither.
        is_share: it is at most 1, and printed without the zero before the point.
    """

    name: str
    digits: int = 2
    better: int = 0
    is_share: bool = False

    @property
    def header(self) -> str:
        """Its name, with an arrow to where it is better."""
        return self.name + {1: " ↑", -1: " ↓", 0: ""}[self.better]


_KNOWN = {
    "psnr": Metric("PSNR", 2, 1),
    "ssim": Metric("SSIM", 3, 1, is_share=True),
    "lpips": Metric("LPIPS", 3, -1, is_share=True),
    "fps": Metric("FPS", 2, 1),
    "ate_rmse_cm": Metric("ATE RMSE [cm]", 3, -1),
    "ate_mean_cm": Metric("ATE mean [cm]", 3, -1),
    "rpe_rmse_cm": Metric("RPE RMSE [cm]", 3, -1),
    "depth_l1_cm": Metric("Depth L1 [cm]", 2, -1),
    "miou": Metric("mIoU", 3, 1, is_share=True),
    "miou_matched": Metric("mIoU, matched", 3, 1, is_share=True),
    "pq": Metric("PQ", 3, 1, is_share=True),
    "heldout_psnr": Metric("PSNR, held out", 2, 1),
    "heldout_ssim": Metric("SSIM, held out", 3, 1, is_share=True),
    "heldout_lpips": Metric("LPIPS, held out", 3, -1, is_share=True),
    "frames_lost": Metric("Frames lost", 0, -1),
    "wall_s": Metric("Time [s]", 1, -1),
    "peak_memory_mb": Metric("Memory [MB]", 0, -1),
    "gaussians": Metric("Gaussians", 0),
}


def metric_of(name: str) -> Metric:
    """Return how the figure ``name`` is printed."""
    return _KNOWN.get(name, Metric(name, 3))


def paper_rows(results: Results) -> list[Row]:
    """Return the published rows of the same sequences, and then a row a setting and figure."""
    rows: list[Row] = []
    if results.published:
        published = load_published(results.published)
        for found in published.rows:
            source = f"{published.title}, table {found.table}"
            for metric in results.metrics:
                values = found.values.get(metric, {})
                average = found.average(metric, results.sequences)
                if average is None and values.keys().isdisjoint(results.sequences):
                    continue
                cells = [_published(values.get(sequence)) for sequence in results.sequences]
                rows.append(Row(found.system, metric, tuple(cells), _published(average), source))
    for setting in results.settings:
        for metric in results.metrics:
            cells = [_cell(results, sequence, setting, metric) for sequence in results.sequences]
            rows.append(
                Row(f"ggwarp, {setting}", metric, tuple(cells), _published(results.average(setting, metric)))
            )
    return rows


def shown(cell: Cell, metric: str) -> str:
    """Return the text of a cell: 35.37, .941, 35.37 ± 0.20, 35.37 (1 of 2 seeds), not run."""
    if isinstance(cell, State):
        return cell.value
    text = number(cell.value, metric)
    if cell.spread is not None:
        text += f" ± {number(cell.spread, metric)}"
    return f"{text} ({cell.count} of {cell.count + cell.missing} seeds)" if cell.missing else text


def number(value: float, metric: str) -> str:
    """Return ``value`` as papers print that figure."""
    known = metric_of(metric)
    text = f"{value:.{known.digits}f}"
    return text.removeprefix("0") if known.is_share else text


def _cell(results: Results, sequence: str, setting: str, metric: str) -> Cell:
    mean = results.mean(sequence, setting, metric)
    if mean is not None:
        return mean
    states = {run.status for run in results.of(sequence, setting)}
    if "failed" in states:
        return State.FAILED
    return State.NOT_MEASURED if "done" in states else State.NOT_RUN


def _published(value: float | None) -> Cell:
    return State.NOT_MEASURED if value is None else Mean(value, None, 1)
