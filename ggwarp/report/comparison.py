# SPDX-License-Identifier: Apache-2.0
"""Several runs on one page: figures side by side, charts and paths over each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from ggwarp.report.charts import line_chart
from ggwarp.report.html import document, figure, picture_uri, section, table
from ggwarp.report.page import CHARTS, lines_of
from ggwarp.report.plan_view import overlaid_paths, upright
from ggwarp.report.run_data import RunData
from ggwarp.results.metrics import HEADLINE, RESULTS
from ggwarp.types import Float64

_HIGHER = ("psnr", "ssim", "miou", "pq", "fps", "objects_found")
_LOWER = (
    "ate_",
    "rpe_",
    "lpips",
    "depth_l1",
    "frames_lost",
    "frames_skipped",
    "_ms",
    "late",
    "wall_s",
    "memory",
)
_PICTURES = 3  # frames shown side by side
_PICTURE_BYTES = 3_000_000


def comparison(runs: Sequence[RunData]) -> str:
    """Return the page that compares ``runs``, two or more."""
    names = _names(runs)
    body = [
        f"<header><h1>{len(runs)} runs</h1><p>{escape(', '.join(names))}</p>"
        '<button id="theme" title="dark or light">◐</button></header>',
        section("Headline", _figures(runs, names, {"": HEADLINE})),
        section("Paths", _paths(runs, names)),
        section("Frame by frame", f'<div class="charts">{_charts(runs, names)}</div>'),
        section("The same frames", _pictures(runs, names)),
        section("Options in which they differ", _options(runs, names)),
        section("All figures", _figures(runs, names, RESULTS)),
    ]
    return document(f"{', '.join(names)} – ggwarp", "".join(body))  # noqa: RUF001 - a dash


def _names(runs: Sequence[RunData]) -> list[str]:
    """Return what tells the runs apart: folder names, with their parents' where these are the same."""
    folders = [run.folder.resolve() for run in runs]
    short = [folder.name for folder in folders]
    if len(set(short)) == len(short):
        return short
    return [f"{folder.parent.name}/{folder.name}" for folder in folders]


def _figures(runs: Sequence[RunData], names: Sequence[str], groups: Mapping[str, Sequence[str]]) -> str:
    parts = []
    for title, keys in groups.items():
        rows = []
        for key in keys:
            values = [run.metrics.get(key) for run in runs]
            if any(value is not None for value in values):
                best = _best(key, values)
                cells = [
                    f"<strong>{figure(v)}</strong>" if best is not None and v == best else figure(v)
                    for v in values
                ]
                rows.append([key, *cells])
        if rows:
            parts.append(table([title, *names], rows, numbers=" " + "n" * len(names)))
    return "".join(parts)


def _best(key: str, values: Sequence[Any]) -> float | None:
    """Return the value that is better than all others; None where there is no such thing."""
    known = [v for v in values if isinstance(v, (int, float)) and not isinstance(v, bool)]
    if len(known) < 2 or min(known) == max(known):
        return None
    if key.removeprefix("heldout_").startswith(_HIGHER):
        return max(known)
    return min(known) if any(part in key for part in _LOWER) else None


def _paths(runs: Sequence[RunData], names: Sequence[str]) -> str:
    """Return the paths over each other; each in its own run's world, which for one recording is the same."""
    first = next((run for run in runs if run.poses is not None), None)
    if first is None:
        return ""
    R = upright(first)
    paths: list[tuple[str, Float64]] = [
        (name, run.poses[:, :3, 3] @ R.T)
        for name, run in zip(names, runs, strict=True)
        if run.poses is not None
    ]
    return _legend(names) + overlaid_paths(paths)


def _charts(runs: Sequence[RunData], names: Sequence[str]) -> str:
    charts = []
    for title, unit, columns in CHARTS:
        for column in columns:
            lines = [
                line
                for k, (name, run) in enumerate(zip(names, runs, strict=True))
                for line in lines_of(run, (column,), colour=k, name=name)
            ]
            heading = title if len(columns) == 1 else f"{title}: {column[1]}"
            charts.append(line_chart(heading, unit, lines))
    return "".join(charts)


def _pictures(runs: Sequence[RunData], names: Sequence[str]) -> str:
    """Return renders of frames that all runs have, side by side."""
    shared = sorted(
        set.intersection(*({i for i, k in run.pictures.items() if "render" in k} for run in runs))
    )
    if not shared:
        return ""
    chosen = [shared[int(at)] for at in np.linspace(0, len(shared) - 1, min(_PICTURES, len(shared))).round()]
    rows, room = [], _PICTURE_BYTES
    for index in dict.fromkeys(chosen):
        files = [runs[0].pictures[index].get("frame"), *(run.pictures[index]["render"] for run in runs)]
        room -= sum(path.stat().st_size for path in files if path is not None and path.is_file())
        if room < 0:
            break
        pictures = (
            f'<img class="wide" alt="" src="{picture_uri(p)}">' if p is not None else "" for p in files
        )
        rows.append([str(index), *pictures])
    return table(["frame", "recorded", *names], rows) if rows else ""


def _options(runs: Sequence[RunData], names: Sequence[str]) -> str:
    changed = [{flag: value for flag, value, _ in run.options} for run in runs]
    defaults = {flag: default for run in runs for flag, _, default in run.options}
    rows = []
    for flag in sorted(defaults):
        values = [options.get(flag, defaults[flag]) for options in changed]
        if len(set(values)) > 1:
            rows.append([f"<code>{escape(flag)}</code>", *(f"<code>{escape(v)}</code>" for v in values)])
    return table(["option", *names], rows) if rows else ""


def _legend(names: Sequence[str]) -> str:
    keys = "".join(f'<span class="key c{k % 8}">{escape(name)}</span>' for k, name in enumerate(names))
    return f'<p class="legend">{keys}</p>'
