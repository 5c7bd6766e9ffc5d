# SPDX-License-Identifier: Apache-2.0
"""Objects shown: a table of them, and pictures of one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ggwarp.editing.actions import chosen_gaussians
from ggwarp.editing.device import ready_device
from ggwarp.editing.map_view import MapView, best_views, crop_to
from ggwarp.editing.trimming import trimmed
from ggwarp.io.atomic import atomic_write
from ggwarp.io.ply import write_ply
from ggwarp.io.printable import printable
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.results.saved_run import RunError, SavedRun
from ggwarp.types import Float32

_WIDE = 130  # columns where there is no terminal to ask
_DIMMED = 0.35  # brightness of what is not meant
_COMPARED = 24  # poses looked from for a difference
_SEARCHED = 0.5  # of the images' size, at which the difference is looked for
_NO_CHANGE = 1e-4  # of brightness, mean over a picture
_SHOWN_WIDTH, _GAP = 640, 8  # pixels
_MARGIN = 16  # pixels round a crop
_ZOOM = 4.0  # of crops, as an object fills a small part of the run's images


def print_table(run: SavedRun) -> None:
    """Print the objects of ``run``, a row each."""
    title = f"{run.folder}: {len(run.objects)} objects, {len(run.gaussians):,} Gaussians"
    table = Table(title=Text(printable(title), style="table.title"))
    for title in ("id", "name", "Gaussians", "size m", "centre m", "colour", "views", "frames", "confidence"):
        table.add_column(title, justify="left" if title in ("name", "colour") else "right")
    for record in run.objects:
        table.add_row(*_row(record))
    if run.edits:
        edits = " ".join(["edited:", *(printable(entry["edit"]) for entry in run.edits)])
        table.caption = Text(edits, style="table.caption")
    console = Console()
    (console if console.is_terminal else Console(width=_WIDE)).print(table)


def _row(o: ObjectRecord) -> list[str | Text]:
    size = " x ".join(f"{2.0 * h:.2f}" for h in o.oriented_box.half_sizes)
    if o.oriented_box.sigmas is not None:
        size += f" ± {max(o.oriented_box.sigmas):.2f}"
    centre = " ".join(f"{c:.2f}" for c in o.centre)
    hexadecimal = "#{:02x}{:02x}{:02x}".format(*o.colour)
    frames = "-" if o.first_frame is None else f"{o.first_frame}-{o.last_frame}"
    confidence = "-" if o.confidence is None else f"{o.confidence:.3f}"
    views = "-" if o.views is None else str(o.views)
    colour = Text.assemble(("███", hexadecimal), f" {hexadecimal}")
    name = Text(printable(o.name))
    return [str(o.id), name, f"{o.count:,}", size, centre, colour, views, frames, confidence]


def write_show(run: SavedRun, record: ObjectRecord, step: argparse.Namespace, folder: Path) -> None:
    """Write ``view1.png``, ... to ``folder``: the map from the object's best views, all else dimmed.

    Raises:
        RunError: a file exists, or nothing is to be seen.
    """
    chosen = chosen_gaussians(run, record, step)
    view = MapView(run.gaussians, run.camera, device=ready_device(step.device))
    indices = _views(view, run, chosen, record, step.views)
    files = _free([folder / f"view{k + 1}.png" for k in range(len(indices))])
    for path, index in zip(files, indices, strict=True):
        T_wc = run.poses[index]
        picture = lit(view.render(T_wc).rgb, view.coverage(T_wc, chosen)[0])
        _save(path, picture)
    _report(files)


def write_extract(run: SavedRun, record: ObjectRecord, step: argparse.Namespace, folder: Path) -> None:
    """Write ``object.ply`` and ``alone1.png``, ... to ``folder``: the object without the rest, cropped.

    The pictures are transparent where the object is not. Gaussians are cut back to where it is seen.

    Raises:
        RunError: a file exists, or nothing is to be seen.
    """
    chosen = chosen_gaussians(run, record, step)
    device = ready_device(step.device)
    whole = MapView(run.gaussians, run.camera, device=device)
    indices = _views(whole, run, chosen, record, step.views)
    ply = folder / "object.ply"
    files = [folder / f"alone{k + 1}.png" for k in range(len(indices))]
    _free([ply, *files])
    alone = trimmed(whole, chosen, run.poses)
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(ply, alone)
    camera = run.camera.scaled(_ZOOM)
    view = MapView(alone, camera, device=device)
    for path, index in zip(files, indices, strict=True):
        seen = view.render(run.poses[index])
        opacity = seen.opacity[..., None]
        # What is rendered is colour times opacity; a picture with alpha keeps them apart.
        straight = np.divide(seen.rgb, opacity, out=np.zeros_like(seen.rgb), where=opacity > 1e-3)
        _save(path, np.concatenate([straight, opacity], axis=2)[crop_to(seen.opacity > 0.1, margin=_MARGIN)])
    _report([ply, *files])


def lit(rgb: Float32, coverage: Float32) -> Float32:
    """Return ``rgb`` [h, w, 3] grey and dark where ``coverage`` [h, w] is 0, unchanged where it is 1."""
    grey = rgb @ np.array([0.299, 0.587, 0.114], np.float32)
    share = np.clip(coverage, 0.0, 1.0)[..., None]
    return np.asarray(share * rgb + (1.0 - share) * _DIMMED * grey[..., None], np.float32)


def before_and_after(before: SavedRun, after: SavedRun, *, device: Any = "cpu") -> NDArray[np.uint8] | None:
    """Return two pictures [h, 2 w + gap, 3] from the pose of the run whose view an edit changed most.

    None: no view shows a difference.
    """
    small = before.camera.scaled(_SEARCHED)
    views = [MapView(run.gaussians, small, device=device) for run in (before, after)]
    rows = np.unique(np.linspace(0, len(before.poses) - 1, _COMPARED).astype(int)).tolist()
    changes = []
    for row in rows:
        one, other = (view.render(before.poses[row]).rgb for view in views)
        changes.append(float(np.abs(one - other).mean()))
    best = int(np.argmax(changes))
    if changes[best] < _NO_CHANGE:
        return None
    camera = before.camera.scaled(max(1.0, _SHOWN_WIDTH / before.camera.width))
    sides = [view.through(camera).render(before.poses[rows[best]]).rgb for view in views]
    gap = np.ones((camera.height, _GAP, 3), np.float32)
    return as_bytes(np.concatenate([sides[0], gap, sides[1]], axis=1))


def write_before_and_after(before: SavedRun, after: SavedRun, folder: Path, *, device: str | None) -> None:
    """Write ``before_after.png`` to ``folder``, and say so; nothing where no view shows a difference.

    Args:
        device: as the command names it; None: auto.

    Raises:
        OSError: the file cannot be written.
    """
    picture = before_and_after(before, after, device=ready_device(device))
    if picture is not None:
        path = folder / "before_after.png"
        _save(path, picture / np.float32(255.0))
        _report([path])


def as_bytes(picture: Float32) -> NDArray[np.uint8]:
    """Return a picture in 0..1 as bytes."""
    return np.rint(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)


def _views(
    view: MapView, run: SavedRun, chosen: NDArray[np.bool_], record: ObjectRecord, count: int
) -> list[int]:
    if count < 1:
        raise RunError(f"--views {count}: give a positive number")
    indices = best_views(view, run.poses, chosen, count=count)
    if not indices:
        raise RunError(f"{record.name}: is hidden or out of sight in every frame of the run")
    return indices


def _free(files: list[Path]) -> list[Path]:
    for path in files:
        if path.exists():
            raise RunError(f"{path}: exists already, and nothing is overwritten; choose another --out")
    return files


def _save(path: Path, picture: NDArray[Any]) -> None:
    """Write ``picture`` [h, w, 3 or 4] in 0..1 as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = as_bytes(picture)
    order = [2, 1, 0, 3][: pixels.shape[2]]
    with atomic_write(path) as file:
        file.write(cv2.imencode(".png", pixels[..., order])[1].tobytes())


def _report(files: list[Path]) -> None:
    for path in files:
        print(printable(str(path)))
