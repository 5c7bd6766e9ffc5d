# SPDX-License-Identifier: Apache-2.0
"""Line charts as inline SVG."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from ggwarp.types import Float64

WIDTH, HEIGHT = 720, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 8, 8, 20
_MOST_POINTS = 600
_OUTLIERS = 99.5  # percent of the values that a chart shows in full


@dataclass(frozen=True)
class Line:
    """One line of a chart.

    Attributes:
        name: in the legend.
        x, y: [n]; nan where nothing was measured.
        colour: a number, of the style sheet's eight.
    """

    name: str
    x: Float64
    y: Float64
    colour: int = 0


def line_chart(title: str, unit: str, lines: Sequence[Line], *, marks: Sequence[float] = ()) -> str:
    """Return a chart with a heading; empty where none of ``lines`` has a value.

    Args:
        marks: where on the x axis something happened, such as a lost frame.
    """
    lines = [line for line in lines if np.isfinite(line.y).any()]
    if not lines:
        return ""
    xs = np.concatenate([line.x for line in lines])
    ys = np.concatenate([line.y[np.isfinite(line.y)] for line in lines])
    x0, x1 = float(xs.min()), float(max(xs.max(), xs.min() + 1.0))
    low, high = float(min(ys.min(), 0.0)), float(np.percentile(ys, _OUTLIERS))
    if low == 0.0 and ys.min() > 0.6 * high:  # PSNR from 30 to 36 needs no zero
        low = float(ys.min()) - 0.1 * (high - float(ys.min()))
    ticks = _ticks(low, high if high > low else low + 1.0)
    low, high = min(low, ticks[0]), max(high, ticks[-1])

    def px(x: Float64 | float) -> Float64:
        return _LEFT + (np.asarray(x, np.float64) - x0) / (x1 - x0) * (WIDTH - _LEFT - _RIGHT)

    def py(y: Float64 | float) -> Float64:
        at = HEIGHT - _BOTTOM - (np.asarray(y, np.float64) - low) / (high - low) * (HEIGHT - _TOP - _BOTTOM)
        return np.maximum(at, 1.0)

    parts = []
    for tick in ticks:
        y = float(py(tick))
        parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}"/>')
        parts.append(f'<text class="tick end" x="{_LEFT - 5}" y="{y + 3.5:.1f}">{_figure(tick)}</text>')
    for tick in _ticks(x0, x1, 6):
        parts.append(
            f'<text class="tick mid" x="{float(px(tick)):.1f}" y="{HEIGHT - 5}">{_figure(tick)}</text>'
        )
    for mark in sorted({round(float(px(mark))) for mark in marks}):
        parts.append(f'<path class="mark" d="M{mark} {_TOP}V{HEIGHT - _BOTTOM}"/>')
    data = []
    for line in lines:
        x, y = thinned(line.x, line.y)
        parts.append(f'<path class="line c{line.colour % 8}" d="{_path(px(x), py(y))}"/>')
        rows = [
            [round(float(a), 3), float(f"{b:.5g}")] for a, b in zip(x, y, strict=True) if math.isfinite(b)
        ]
        data.append({"name": line.name, "colour": line.colour % 8, "rows": rows})
    frame = {"x0": x0, "x1": x1, "left": _LEFT, "right": WIDTH - _RIGHT, "width": WIDTH, "unit": unit}
    legend = "".join(f'<span class="key c{line.colour % 8}">{escape(line.name)}</span>' for line in lines)
    return (
        f'<figure class="chart"><figcaption>{escape(title)} <small>{escape(unit)}</small>'
        f'<span class="legend">{legend if len(lines) > 1 else ""}</span><output></output></figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">{"".join(parts)}'
        f'<path class="cursor" d=""/></svg>'
        f'<script type="application/json">{script_safe({"lines": data, **frame})}</script></figure>'
    )


def thinned(x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """Return at most some hundred of the points, of each stretch the lowest and the highest."""
    if len(x) <= _MOST_POINTS:
        return x, y
    keep: list[int] = []
    for part in np.array_split(np.arange(len(x)), _MOST_POINTS // 2):
        values = y[part]
        if np.isfinite(values).any():
            keep += sorted({int(part[np.nanargmin(values)]), int(part[np.nanargmax(values)])})
        else:
            keep.append(int(part[0]))
    return x[keep], y[keep]


def script_safe(value: object) -> str:
    """Return ``value`` as JSON that can stand in a page's script: no tag ends it."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _path(x: Float64, y: Float64) -> str:
    """Return the SVG path of a line that is broken where y is nan; a lone point is a dot."""
    parts, pen = [], False
    for number, (a, b) in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
        if not math.isfinite(b):
            pen = False
            continue
        parts.append(f"{'L' if pen else 'M'}{a:.1f} {b:.1f}")
        if not pen and (number + 1 == len(y) or not math.isfinite(y[number + 1])):
            parts.append("h0.1")
        pen = True
    return "".join(parts)


def _ticks(low: float, high: float, most: int = 4) -> list[float]:
    """Return round numbers within ``low`` .. ``high``, two at least."""
    raw = max((high - low) / most, 1e-9)
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(m * magnitude for m in (1.0, 2.0, 5.0, 10.0) if m * magnitude >= raw)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [n * step for n in range(first, max(last, first + 1) + 1)]


def _figure(value: float) -> str:
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if abs(value) >= 1e4 else f"{value:.6g}"
