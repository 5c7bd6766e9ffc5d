# SPDX-License-Identifier: Apache-2.0
"""A record as a picture (PNG), drawn with matplotlib where it is installed."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarking import kernels, scaling, system, tracking
from benchmarking.endurance import memory
from benchmarking.record import Record, Row


class NoMatplotlibError(RuntimeError):
    """There is nothing to draw with: one line for the user."""


def draw(record: Record, stem: Path) -> list[Path]:
    """Draw what ``record`` has a plot for to ``stem`` plus ``.png``; return the files.

    Raises:
        NoMatplotlibError: matplotlib is not installed.
    """
    try:
        importlib.import_module("matplotlib").use("Agg")
        plt = importlib.import_module("matplotlib.pyplot")
    except ImportError:
        raise NoMatplotlibError("no plots without matplotlib: pip install 'ggwarp[benchmark]'") from None
    figure = _DRAWINGS[record.benchmark](plt, record)
    if figure is None:
        return []
    m = record.machine
    figure.suptitle(f"{record.benchmark}: {m['device']} ({m['cpu']}), commit {m['commit']}", fontsize=9)
    figure.tight_layout()
    path = stem.with_name(f"{stem.name}.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return [path]


def _rows(record: Record, title: str) -> list[Row]:
    section = record.section(title)
    return section.rows if section is not None else []


def _kernels(plt: Any, record: Record) -> Any:
    rows = _rows(record, kernels.STAGES)[::-1]
    figure, axes = plt.subplots(figsize=(7, 4))
    places = range(len(rows))
    axes.barh(places, [r["ms"] for r in rows], label="measured")
    axes.barh(places, [r["least ms"] for r in rows], height=0.4, label="least, at the machine's limits")
    axes.set_yticks(list(places), [r["stage"] for r in rows])
    axes.set_xlabel("ms")
    axes.legend()
    return figure


def _tracking(plt: Any, record: Record) -> Any:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
    rows = [r for r in _rows(record, tracking.BESIDE) if r["small_gicp ms"] is not None]
    places = list(range(len(rows)))
    left.barh([p + 0.2 for p in places], [r["ours ms"] for r in rows], height=0.4, label="ggwarp")
    left.barh([p - 0.2 for p in places], [r["small_gicp ms"] for r in rows], height=0.4, label="small_gicp")
    left.set_yticks(places, [f"{r['what']}, {r['threads']}" for r in rows], fontsize=7)
    left.set_xlabel("ms (after the comma: threads)")
    left.legend()
    _growth(right, record)
    return figure


def _growth(axes: Any, record: Record) -> None:
    rows = _rows(record, tracking.GROWTH)
    sizes = [r["map points"] for r in rows]
    for column in ("frame ms", "map, once a keyframe, ms"):
        axes.loglog(sizes, [r[column] for r in rows], "o-", label=column)
    _mark_sizes(axes, sizes)
    axes.set_xlabel("trackable points in the map")
    axes.set_ylabel("ms")
    axes.legend()


def _mark_sizes(axes: Any, sizes: list[float]) -> None:
    """Write the sizes measured, and plain numbers up the side of a log-log plot."""
    axes.minorticks_off()
    axes.set_xticks(sizes, [f"{s / 1e6:.3g}M" if s >= 1e6 else f"{s / 1e3:.3g}k" for s in sizes], fontsize=8)
    low, high = axes.get_ylim()
    steps = [digit * 10.0**power for power in range(-3, 6) for digit in (1, 2, 5)]
    inside = [step for step in steps if low <= step <= high]
    axes.set_yticks(inside, [f"{step:g}" for step in inside])


def _scaling(plt: Any, record: Record) -> Any:
    figure, axes = plt.subplots(1, 3, figsize=(13, 4))
    panels = (
        (axes[0], "Gaussians", (scaling.COVERED, scaling.SAME_SIZE)),
        (axes[1], "pixels", (scaling.PIXELS,)),
    )
    for panel, by, titles in panels:
        for title in titles:
            rows = _rows(record, title)
            sizes, times = [r[by] for r in rows], [r["ms"] for r in rows]
            fitted = scaling.exponent(sizes, times)
            panel.loglog(sizes, times, "o-", label=f"{title}: exponent {fitted:.2f}")
        _mark_sizes(panel, [r[by] for r in _rows(record, titles[0])])
        panel.set_xlabel(by)
        panel.set_ylabel("ms an iteration")
        panel.legend(fontsize=7)
    _growth(axes[2], record)
    return figure


def _system(plt: Any, record: Record) -> Any:
    rows = _rows(record, system.STAGES)
    if not rows:
        return None
    figure, axes = plt.subplots(figsize=(8, 1.5 + 0.5 * len(rows)))
    names = [" ".join(str(r[k]) for k in ("sequence", "preset", "cap")) for r in rows]
    begins = [0.0] * len(rows)
    for stage in ("tracking", "insertion", "mapping", "rest"):
        shares = [r.get(f"{stage} %") or 0.0 for r in rows]
        axes.barh(names, shares, left=begins, label=stage)
        begins = [b + s for b, s in zip(begins, shares, strict=True)]
    axes.set_xlabel("% of the loop's time")
    axes.legend(ncol=4, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def _memory(plt: Any, record: Record) -> Any:
    rows = _rows(record, memory.COURSE)
    if not rows:
        return None
    panels = {
        "MB": ("resident MB", "images in memory MB", "in the file MB"),
        "in the map": ("Gaussians", "Gaussians in memory", "trackable points"),
        "CPU ms a frame": ("tracking ms", "mapping ms"),
        "mm": ("largest error mm",),
    }
    if rows[0].get("largest error mm") is None:  # where the truth is not known
        panels.pop("mm")
    figure, axes = plt.subplots(1, len(panels), figsize=(4.4 * len(panels), 4))
    for panel, (unit, columns) in zip(axes, panels.items(), strict=True):
        for column in columns:
            panel.plot([r["frames"] for r in rows], [r[column] for r in rows], label=column)
        panel.set_xlabel("frames")
        panel.set_ylabel(unit)
        panel.set_ylim(bottom=0)
        panel.legend(fontsize=7)
    return figure


_DRAWINGS: dict[str, Callable[[Any, Record], Any]] = {
    "kernels": _kernels,
    "tracking": _tracking,
    "system": _system,
    "scaling": _scaling,
    "memory": _memory,
}
"""Subcommand -> its figure; None where there is nothing to show."""
