# SPDX-License-Identifier: Apache-2.0
"""The map from above and from the side, with the camera's path and the objects' boxes over it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np

from ggwarp.geometry import se3
from ggwarp.map.gaussians import SH_C0
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.report.colours import object_colour
from ggwarp.report.run_data import RunData
from ggwarp.types import Float32, Float64

_WIDTH = 640  # pixels of the picture
_TALLEST = 560
_TRIM = 0.5  # percent of the Gaussians beyond the picture on each side
_MOST = 400_000  # Gaussians that are drawn
_FEW = 20_000  # Gaussians that the room's direction is taken from
_SPOT = 4.0  # pixels between marks of lost frames
_SPREAD = 1.5  # standard deviations that a Gaussian is drawn with
_HEADROOM = 0.1  # metres above the highest camera: what is higher hides the room
_ABOVE, _SIDE = (0, 1), (0, 2)  # of x to the right, y ahead, z up
_BAR = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # metres


@dataclass(frozen=True)
class Path2D:
    """A path to draw.

    Attributes:
        name: in the legend.
        points: [n, 3] metres, upright axes.
        style: its class in the style sheet.
    """

    name: str
    points: Float64
    style: str


@dataclass(frozen=True)
class _Frame:
    """Where metres are on a picture: origin (least across, most up), pixels a metre, size."""

    left: float
    top: float
    scale: float
    width: int
    height: int

    def at(self, points: Float64, axes: tuple[int, int]) -> Float64:
        """Return [n, 2] pixels of ``points`` [n, 3]."""
        across, up = points[:, axes[0]], points[:, axes[1]]
        return np.stack([(across - self.left) * self.scale, (self.top - up) * self.scale], axis=1)


def plan_views(run: RunData) -> str:
    """Return figures of the run from above and from the side; empty where nothing is known of its path."""
    if run.poses is None:
        return ""
    R = upright(run)
    paths = [Path2D("camera", run.poses[:, :3, 3] @ R.T, "path")]
    if run.live is not None:
        paths.insert(0, Path2D("as reported live", run.live @ R.T, "path live"))
    if run.truth is not None:
        paths.insert(0, Path2D("truth, aligned", run.truth @ R.T, "path truth"))
    lost, loops = _events(run, R)
    views = []
    for name, axes in (("From above", _ABOVE), ("From the side", _SIDE)):
        frame, picture = _background(run, R, [path.points for path in paths], axes)
        drawn = [
            picture,
            *_boxes(run.largest_objects, R, frame, axes),
            *(_polyline(p, frame, axes) for p in paths),
        ]
        drawn += [f'<path class="loop" d="{_segments(frame.at(ends, axes))}"/>' for ends in loops]
        spots = np.unique(np.rint(frame.at(lost, axes) / _SPOT), axis=0) * _SPOT
        drawn += [f'<circle class="lost" cx="{x:g}" cy="{y:g}" r="3"/>' for x, y in spots]
        start = frame.at(paths[-1].points[:1], axes)[0]
        drawn.append(f'<circle class="start" cx="{start[0]:.1f}" cy="{start[1]:.1f}" r="4"/>')
        views.append(_figure(name, frame, drawn))
    legend = "".join(f'<span class="key {path.style}">{escape(path.name)}</span>' for path in paths)
    legend += '<span class="key dot start">start</span>'
    legend += '<span class="key dot lost">lost</span>' if len(lost) else ""
    legend += '<span class="key path loop">loop closed</span>' if loops else ""
    boxes = '<label><input type="checkbox" id="boxes"> objects\' boxes</label>' if run.objects else ""
    return f'<p class="legend">{legend} {boxes}</p><div class="views">{"".join(views)}</div>'


def upright(run: RunData) -> Float64:
    """Return the rotation [3, 3] from the run's world to z up, the room's longer side across."""
    R = np.eye(3) if run.view is None else run.view.rotation_to("z-up")
    if run.gaussians is None or len(run.gaussians) < 3:
        return R
    flat = run.gaussians.means[:: 1 + len(run.gaussians) // _FEW] @ R.T[:, :2]
    inner = np.abs(flat - np.median(flat, axis=0)) <= np.percentile(
        np.abs(flat - np.median(flat, axis=0)), 98.0
    )
    _, (width, height), angle = cv2.minAreaRect(flat[inner.all(axis=1)].astype(np.float32))
    turn = np.radians(-angle if width >= height else 90.0 - angle)
    turn = (turn + np.pi / 2.0) % np.pi - np.pi / 2.0  # what is ahead stays ahead
    return se3.so3_exp([0.0, 0.0, turn]) @ R


def overlaid_paths(runs: Sequence[tuple[str, Float64]]) -> str:
    """Return one figure of several paths from above.

    Args:
        runs: name and [n, 3] positions, upright axes, metres.
    """
    frame = _frame_of(np.concatenate([points for _, points in runs]), _ABOVE)
    drawn = [
        f'<path class="line c{k % 8}" d="{_segments(frame.at(points, _ABOVE))}">'
        f"<title>{escape(name)}</title></path>"
        for k, (name, points) in enumerate(runs)
    ]
    return f'<div class="alone">{_figure("From above", frame, drawn)}</div>'


def _figure(name: str, frame: _Frame, drawn: Sequence[str]) -> str:
    bar = max((b for b in _BAR if b * frame.scale < 0.3 * frame.width), default=_BAR[0])
    x, y = 10, frame.height - 10
    scale = (
        f'<path class="bar halo" d="M{x} {y}h{bar * frame.scale:.1f}"/>'
        f'<path class="bar" d="M{x} {y}h{bar * frame.scale:.1f}"/>'
        f'<text class="barname" x="{x}" y="{y - 5}">{bar:g} m</text>'
    )
    return (
        f'<figure><figcaption>{name}</figcaption><svg class="plan" role="img" aria-label="{name}" '
        f'viewBox="0 0 {frame.width} {frame.height}">{"".join(drawn)}{scale}</svg></figure>'
    )


def _background(
    run: RunData, R: Float64, paths: Sequence[Float64], axes: tuple[int, int]
) -> tuple[_Frame, str]:
    """Return where things are, and the map's picture as an SVG image; none without a map."""
    track = np.concatenate(paths)
    if run.gaussians is None or not len(run.gaussians):
        return _frame_of(track, axes), ""
    g = run.gaussians.take(
        np.flatnonzero(run.gaussians.opacity_logits > 0.0)[:: 1 + len(run.gaussians) // _MOST]
    )
    points = np.asarray(g.means, np.float64) @ R.T
    trimmed = np.percentile(points, [_TRIM, 100.0 - _TRIM], axis=0) if len(points) else track
    frame = _frame_of(np.concatenate([trimmed, track]), axes)
    # Ceiling and the wall in front would hide the room.
    hidden = (
        points[:, 2] > track[:, 2].max() + _HEADROOM if axes == _ABOVE else points[:, 1] < track[:, 1].min()
    )
    colours = np.clip(0.5 + SH_C0 * g.colours, 0.0, 1.0)
    nearer = points[:, 2] if axes == _ABOVE else -points[:, 1]
    radii = _SPREAD * np.exp(g.log_scales.max(axis=1)) * frame.scale
    picture = _drawn(
        frame, frame.at(points, axes)[~hidden], colours[~hidden], nearer[~hidden], radii[~hidden]
    )
    data = base64.b64encode(
        cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, 70])[1].tobytes()
    ).decode()
    image = f'<image href="data:image/webp;base64,{data}" width="{frame.width}" height="{frame.height}"/>'
    return frame, image


def _drawn(frame: _Frame, at: Float64, colours: Float32, nearer: Float64, radii: Float64) -> np.ndarray:
    """Return BGRA [h, w, 4]: points as squares, the nearest on top."""
    order = np.argsort(nearer, kind="stable")
    colours, radii = colours[order], radii[order]
    pixels = np.rint(at[order]).astype(np.intp)
    picture = np.zeros((frame.height, frame.width, 4), np.uint8)
    depth = np.full((frame.height, frame.width), -1)
    ink = np.concatenate([np.rint(255.0 * colours[:, ::-1]), np.full((len(pixels), 1), 255)], axis=1).astype(
        np.uint8
    )
    rank = np.arange(len(pixels))
    for dy in (-2, -1, 0, 1, 2):
        for dx in (-2, -1, 0, 1, 2):
            x, y = pixels[:, 0] + dx, pixels[:, 1] + dy
            inside = (radii >= max(abs(dx), abs(dy)) - 0.5) & (x >= 0) & (y >= 0)
            inside &= (x < frame.width) & (y < frame.height)
            np.maximum.at(depth, (y[inside], x[inside]), rank[inside])
    picture[depth >= 0] = ink[depth[depth >= 0]]
    return picture


def _frame_of(points: Float64, axes: tuple[int, int]) -> _Frame:
    low, high = points.min(axis=0) - 0.1, points.max(axis=0) + 0.1
    across, up = high[axes[0]] - low[axes[0]], high[axes[1]] - low[axes[1]]
    scale = min(_WIDTH / across, _TALLEST / up)
    size = max(1, round(across * scale)), max(1, round(up * scale))
    return _Frame(float(low[axes[0]]), float(high[axes[1]]), float(scale), *size)


def _events(run: RunData, R: Float64) -> tuple[Float64, list[Float64]]:
    """Return where frames were lost [n, 3], and the ends [2, 3] of each closed loop."""
    assert run.poses is not None
    table = run.frames.tracked()
    if len(table) != len(run.poses):
        return np.zeros((0, 3)), []
    at = run.poses[:, :3, 3] @ R.T
    rows = {index: row for row, index in enumerate(table.indices())}
    lost = [row for row, verdict in enumerate(table.text("verdict")) if verdict == "lost"]
    pairs = enumerate(table.numbers("loop_with"))
    loops = [at[[row, rows[int(other)]]] for row, other in pairs if np.isfinite(other) and int(other) in rows]
    return at[lost], loops


def _polyline(path: Path2D, frame: _Frame, axes: tuple[int, int]) -> str:
    return f'<path class="{path.style}" d="{_segments(frame.at(path.points, axes))}"/>'


def _segments(points: Float64) -> str:
    step = -(-len(points) // 2000)
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points[::step])


def _boxes(objects: Sequence[ObjectRecord], R: Float64, frame: _Frame, axes: tuple[int, int]) -> list[str]:
    """Return the outlines of the objects' own boxes, hidden until they are asked for."""
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    drawn = []
    for record in objects:
        box = record.oriented_box
        points = (np.array(box.centre) + (corners * box.half_sizes) @ se3.matrix_from_quat(box.quat).T) @ R.T
        hull = cv2.convexHull(frame.at(points, axes).astype(np.float32))[:, 0]
        r, g, b = object_colour(record.id)
        outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in hull)
        drawn.append(
            f'<polygon class="box" stroke="rgb({r},{g},{b})" points="{outline}">'
            f"<title>{escape(record.name)}</title></polygon>"
        )
    return drawn
