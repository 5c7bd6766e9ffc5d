# SPDX-License-Identifier: Apache-2.0
"""``report.html``: one run on one page."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.io.atomic import atomic_write
from ggwarp.report.charts import Line, line_chart, script_safe
from ggwarp.report.colours import DIFFERENCE_GAIN, object_colour
from ggwarp.report.gallery import KINDS
from ggwarp.report.html import document, figure, notes, picture_uri, section, table
from ggwarp.report.plan_view import plan_views
from ggwarp.report.run_data import RunData, read_run
from ggwarp.results.metrics import RESULTS
from ggwarp.types import Float64

FILE = "report.html"

_PICTURE_BYTES = 2_500_000  # of all pictures of frames: a page has 5 MB at most, and text takes a third more
_CROP_BYTES = 400_000
_MOST_REASONS = 5
_PLAN = ("layout", "frames", "pairing", "camera", "depth", "masks", "truth")

CHARTS: tuple[tuple[str, str, tuple[tuple[str, str], ...]], ...] = (
    ("Time", "ms", (("tracking_ms", "tracking"), ("mapping_ms", "mapping"))),
    ("Overlap with the map", "share", (("overlap", "overlap"),)),
    ("Position error, aligned", "cm", (("ate_cm", "error"),)),
    (
        "Uncertainty of the position",
        "cm",
        (("position_std_cm", "standard deviation, with drift"),),
    ),
    ("Depth noise, and misfit of the points", "mm", (("depth_noise_mm", "noise"), ("rmse_mm", "misfit"))),
    ("PSNR", "dB", (("psnr", "as it is"), ("psnr_exposed", "exposure fitted"))),
    ("SSIM", "", (("ssim", "SSIM"),)),
    ("Depth error", "cm", (("depth_l1_cm", "depth"),)),
    ("Gaussians", "", (("gaussians", "Gaussians"),)),
    ("Mapping loss", "", (("loss", "loss"),)),
)
"""Title, unit, and columns of ``frames.csv`` with their names."""


def write_report(folder: Path) -> None:
    """Write ``report.html`` of the run in ``folder``, from what lies there.

    Raises:
        RunError: it is no run folder.
        OSError: the file cannot be written.
    """
    page = report(read_run(folder))
    with atomic_write(folder / FILE) as file:
        file.write(page.encode())


def report(run: RunData) -> str:
    """Return the page of ``run``."""
    body = [
        _header(run),
        _headline(run.metrics, len(run.objects)),
        notes(list(_failures(run))),
        notes(list(_warnings(run)), mild=True),
        section("Path", plan_views(run)),
        section("Frames and renders", _stage(run)),
        section("Frame by frame", f'<div class="charts">{_charts(run)}</div>'),
        section("Objects", _objects(run)),
        section("What the recording was taken for", _plan(run.metrics)),
        section("All figures", _figures(run.metrics)),
        section("Options that differ from the defaults", _options(run)),
        section("Versions", _versions(run.metrics)),
    ]
    return document(f"{run.title} – ggwarp", "".join(body))  # noqa: RUF001 - a dash


def _header(run: RunData) -> str:
    m = run.metrics
    facts = [str(m[key]) for key in ("dataset", "device") if m.get(key)]
    facts.append(str(run.folder.resolve().name))
    return (
        f"<header><h1>{escape(run.title)}</h1><p>{escape(', '.join(facts))}</p>"
        '<button id="theme" title="dark or light">◐</button></header>'
    )


def _headline(m: dict[str, Any], objects: int) -> str:
    """Return the figures that matter most, as tiles; those not measured say why."""
    truth = f"{m.get('alignment') or 'se3'}, {figure(m.get('ate_live_rmse_cm'), 2)} live"
    if m.get("ate_rmse_cm") is None:
        truth = "no truth"
    compared = "not compared" if m.get("psnr") is None else f"{figure(m.get('heldout_psnr'), 1)} held out"
    miou = "no masks to compare with" if m.get("miou") is None else f"mIoU {figure(m['miou'], 3)}"
    memory, skipped = m.get("peak_memory_mb"), figure(m.get("frames_skipped"))
    keyframes = sum(m.get(name) or 0 for name in ("tracking_keyframes", "mapping_keyframes"))
    tiles = [
        ("ATE", _with_unit(m.get("ate_rmse_cm"), 2, "cm"), truth),
        ("PSNR", _with_unit(m.get("psnr"), 1, "dB"), compared),
        ("Frames a second", figure(m.get("fps"), 1), f"{figure(m.get('wall_s'), 0)} s in all"),
        ("Lost frames", figure(m.get("frames_lost")), f"of {figure(m.get('frames'))}, {skipped} skipped"),
        ("Objects", figure(objects), miou),
        ("Gaussians", figure(m.get("gaussians")), f"{figure(keyframes)} keyframes"),
        ("Memory", _with_unit(None if memory is None else memory / 1024.0, 1, "GiB"), "peak"),
    ]  # fmt: skip
    inner = (
        f'<div class="tile"><span>{name}</span><b>{value}</b><small>{escape(note)}</small></div>'
        for name, value, note in tiles
    )
    return f'<div class="tiles">{"".join(inner)}</div>'


def _with_unit(value: float | None, digits: int, unit: str) -> str:
    return figure(value, digits) + (f" <span>{unit}</span>" if value is not None else "")


def _failures(run: RunData) -> Iterator[str]:
    """Yield what went wrong."""
    if run.metrics.get("interrupted"):
        yield "The run was interrupted; what follows is of the frames before that."
    yield from map(str, run.metrics.get("failures") or [])
    for line in run.faults:
        yield f"Not in this report: {line}"
    if not run.metrics:
        yield "There is no metrics.json: the run did not come to its end."


def _warnings(run: RunData) -> Iterator[str]:
    """Yield what is doubtful."""
    if doubt := run.metrics.get("truth_doubt"):
        yield str(doubt)
    table_ = run.frames
    rows = zip(table_.text("index"), table_.text("verdict"), table_.text("reason"), strict=True)
    bad = [(index, verdict, reason) for index, verdict, reason in rows if verdict in ("lost", "skipped")]
    said = [*((run.metrics.get("plan") or {}).get("warnings") or []), *(run.metrics.get("warnings") or [])]
    of_frames = tuple(f"frame {index} {verdict}" for index, verdict, _ in bad)
    for line in dict.fromkeys(map(str, said)):
        if not line.startswith(of_frames):  # which follow
            yield line
    if len(bad) > _MOST_REASONS:
        lost = sum(verdict == "lost" for _, verdict, _ in bad)
        yield f"{lost} frames lost, {len(bad) - lost} skipped, of {len(table_)}; the first ones:"
    for index, verdict, reason in bad[:_MOST_REASONS]:
        yield f"frame {index} {verdict}: {reason}"
    if len(bad) > _MOST_REASONS:
        yield f"... and {len(bad) - _MOST_REASONS} more, see frames.csv"


def lines_of(
    run: RunData, columns: tuple[tuple[str, str], ...], *, colour: int = 0, name: str = ""
) -> list[Line]:
    """Return the lines of a chart; nan where nothing was measured.

    Args:
        name: of the line, where there is one column alone; empty: the column's.
    """
    x: Float64 = np.array(run.frames.indices(), np.float64)
    lines: list[Line] = []
    for number, (column, label) in enumerate(columns):
        y = np.array(run.frames.numbers(column), np.float64)
        # What says the same as the line before, or nothing, is left out.
        if np.nanmax(np.abs(y), initial=0.0) > 0.0 and not (
            lines and np.allclose(y, lines[0].y, equal_nan=True, rtol=1e-4)
        ):
            lines.append(Line(name or label, x, y, colour + number))
    return lines


def _charts(run: RunData) -> str:
    index = run.frames.indices()
    lost = [
        float(i) for i, verdict in zip(index, run.frames.text("verdict"), strict=True) if verdict == "lost"
    ]
    if not index:
        return '<p class="dim">There is no frames.csv.</p>'
    return "".join(
        line_chart(title, unit, lines_of(run, columns), marks=lost) for title, unit, columns in CHARTS
    )


def _stage(run: RunData) -> str:
    """Return the pictures: one frame large with a slider, all of them as a strip."""
    frames = _within_budget(run.pictures, _PICTURE_BYTES)
    scores = dict(zip(run.frames.indices(), run.frames.numbers("psnr"), strict=True))
    data = [
        {"index": index, "pictures": {kind: picture_uri(path) for kind, path in pictures.items()}}
        for index, pictures in frames.items()
        if {"frame", "render"} <= set(pictures)
    ]
    if not data:
        return '<p class="dim">No pictures: they are taken when the map is compared with its frames.</p>'
    explained = {
        "frame": "frame",
        "difference": f"difference x{DIFFERENCE_GAIN:g}",
        "depth": "depth",
        "objects": "objects",
    }
    there = [kind for kind in KINDS if kind in explained and any(kind in d["pictures"] for d in data)]
    modes = "".join(f'<button value="{kind}">{explained[kind]}</button>' for kind in there)
    strip = "".join(
        f'<button value="{k}" title="frame {d["index"]}"><img alt="frame {d["index"]}">'
        f"{d['index']} · {figure(scores.get(d['index'], float('nan')), 1)} dB</button>"
        for k, d in enumerate(data)
    )
    return (
        '<div class="stage"><img alt="" class="under"><img alt="the map\'s render" class="over">'
        '<div class="seam"></div>'
        '<input type="range" min="0" max="100" value="50" aria-label="share of the render">'
        '<span class="tag left"></span><span class="tag right"></span></div>'
        f'<div class="modes">render beside {modes}</div><div class="strip">{strip}</div>'
        f'<script type="application/json" id="frames">{script_safe(data)}</script>'
    )


def _within_budget(pictures: dict[int, dict[str, Path]], budget: int) -> dict[int, dict[str, Path]]:
    """Return as many frames, evenly spread, as have no more than ``budget`` bytes together."""
    sizes = {i: sum(p.stat().st_size for p in kinds.values() if p.is_file()) for i, kinds in pictures.items()}
    chosen, step = list(pictures), 1
    while sum(sizes[i] for i in chosen) > budget and len(chosen) > 1:
        step += 1
        chosen = list(pictures)[::step]
    return {i: pictures[i] for i in chosen}


def _objects(run: RunData) -> str:
    if not run.objects:
        return ""
    room, rows = _CROP_BYTES, []
    for o in run.largest_objects:
        path = run.crops.get(o.id)
        size = path.stat().st_size if path is not None and path.is_file() else 0
        room -= size
        shown = path is not None and size and room > 0
        crop = f'<img loading="lazy" alt="" src="{picture_uri(path)}">' if shown and path else ""
        r, g, b = object_colour(o.id)
        dimensions = " x ".join(f"{200.0 * h:.0f}" for h in o.oriented_box.half_sizes)
        name = f'<span class="swatch" style="background:rgb({r},{g},{b})"></span>{escape(o.name)}'
        rows.append([
            crop, str(o.id), name, dimensions, f"{o.count:,}", figure(o.views), figure(o.confidence, 2),
            figure(run.scores.get(o.id), 3),
        ])  # fmt: skip
    head = ["", "id", "name", "size, cm", "Gaussians", "views", "confidence", "IoU"]
    left = len(run.objects) - len(rows)
    more = f'<p class="dim">... and {left} smaller ones, see objects.json</p>' if left else ""
    return table(head, rows, numbers=" n  nnnn") + more


def _plan(m: dict[str, Any]) -> str:
    plan = m.get("plan") or {}
    rows = [[key, escape(str(plan[key]))] for key in _PLAN if plan.get(key)]
    if plan.get("unread"):
        rows.append(["not read", escape(", ".join(map(str, plan["unread"])))])
    return table([], rows) if rows else ""


def _figures(m: dict[str, Any]) -> str:
    groups = []
    for title, keys in RESULTS.items():
        rows = [[key, figure(m[key])] for key in keys if m.get(key) is not None]
        groups.append(table([], rows, caption=title, numbers=" n") if rows else "")
    return f'<div class="columns">{"".join(groups)}</div>' if any(groups) else ""


def _options(run: RunData) -> str:
    rows = [
        [
            f"<code>{escape(flag)}</code>",
            f"<code>{escape(value) or '(none)'}</code>",
            f"<code>{escape(default)}</code>",
        ]
        for flag, value, default in run.options
    ]
    return table(["option", "here", "default"], rows) if rows else ""


def _versions(m: dict[str, Any]) -> str:
    versions = m.get("versions") or {}
    return table([], [[escape(str(k)), escape(str(v))] for k, v in versions.items()]) if versions else ""
