# SPDX-License-Identifier: Apache-2.0
"""One edit of a saved run as the command asks for it."""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.editing import edits
from ggwarp.editing.device import ready_device
from ggwarp.editing.progress import Progress, silent
from ggwarp.editing.selection import SelectionConfig, select
from ggwarp.geometry import se3
from ggwarp.io.printable import shown
from ggwarp.map.gaussians import Gaussians, join
from ggwarp.objects.inventory import FROM_KEYFRAMES, ObjectRecord, centre_of, is_name, merged_record
from ggwarp.results.saved_run import RunError, SavedRun
from ggwarp.types import Float64

Bools = NDArray[np.bool_]


def apply(run: SavedRun, step: argparse.Namespace, progress: Progress = silent) -> SavedRun:
    """Return ``run`` after ``step``; see :mod:`ggwarp.editing.command_line` for its fields.

    Args:
        progress: told how far the work is; what it raises ends the work.

    Raises:
        RunError: an object is not there, its selection is empty, or a value is out of range.
    """
    if step.verb in ("remove", "move"):
        return (_remove if step.verb == "remove" else _move)(run, step, progress)
    return {"recolor": _recolour, "label": _label, "merge": _merge, "split": _split}[step.verb](run, step)


def chosen_gaussians(run: SavedRun, record: ObjectRecord, step: argparse.Namespace) -> Bools:
    """Return [n] the Gaussians of ``record`` by the selection options of ``step``.

    Raises:
        RunError: there are none, or the run lacks what the choice needs.
    """
    if step.probability is not None and not 0.0 <= step.probability < 1.0:
        raise RunError(f"--probability {step.probability:g}: give a number from 0 up to 1")
    config = SelectionConfig(
        step.probability, adopt=step.adopt, cut_outliers=step.cut_outliers, fill_hull=step.fill_hull
    )
    try:
        chosen = select(run.gaussians, record.id, config, classifier=run.classifier)
    except ValueError as error:
        raise RunError(f"--probability: {error}; leave it out, or run the sequence again") from None
    if not chosen.any():
        raise RunError(
            f"{record.name}: no Gaussian is chosen; try without --cut-outliers, or a lower --probability"
        )
    return chosen


def _remove(run: SavedRun, step: argparse.Namespace, progress: Progress) -> SavedRun:
    records = [run.find(name) for name in step.ids]
    chosen = np.any([chosen_gaussians(run, record, step) for record in records], axis=0)
    if chosen.all():
        raise RunError("remove: nothing would be left of the map")
    left, added = _without(run, chosen, step, progress)
    return run.edited(left, {"edit": "remove", "ids": [r.id for r in records], "filled": added})


def _without(
    run: SavedRun, chosen: Bools, step: argparse.Namespace, progress: Progress
) -> tuple[Gaussians, int]:
    """Return the map without ``chosen`` and, where holes are filled, how many Gaussians fill them."""
    left = edits.remove(run.gaussians, chosen)
    if not step.fill:
        return left, 0
    from ggwarp.editing.inpaint import filling  # kernels, only needed here

    device = ready_device(step.device)
    return filling.fill_removed(
        run.gaussians, chosen, run.camera, run.poses, device=device, progress=progress
    )


def _move(run: SavedRun, step: argparse.Namespace, progress: Progress) -> SavedRun:
    record = run.find(step.id)
    rotation = _rotation(step)
    chosen = chosen_gaussians(run, record, step)
    centre = centre_of(run.gaussians.means[chosen])
    T = edits.motion_about(centre, rotation=rotation, translation=step.translate or [0.0] * 3)
    moved = edits.move(run.gaussians, chosen, T)
    entry = {"edit": "move", "id": record.id, "T": T.tolist()}
    if step.fill:
        # Its strays, which do not move along, would stay behind as crumbs.
        strays = argparse.Namespace(**{**vars(step), "cut_outliers": False})
        left, added = _without(run, chosen | chosen_gaussians(run, record, strays), step, progress)
        moved = join(left, edits.extract(moved, chosen))
        entry["filled"] = added
    return run.edited(moved, entry)


def _rotation(step: argparse.Namespace) -> Float64:
    if (step.axis is None) != (step.angle is None):
        raise RunError("move: --axis and --angle go together")
    if step.axis is not None and step.rotate is not None:
        raise RunError("move: give --rotate, or --axis and --angle, not both")
    if step.translate is None and step.rotate is None and step.axis is None:
        raise RunError("move: where to? give --translate, --rotate, or --axis and --angle")
    if step.axis is not None:
        axis = np.asarray(step.axis, np.float64)
        if not np.linalg.norm(axis) > 0.0:
            raise RunError("--axis 0 0 0: has no direction")
        return se3.so3_exp(np.radians(step.angle) * axis / np.linalg.norm(axis))
    R = np.eye(3)
    for angle, axis in zip(step.rotate or [0.0] * 3, np.eye(3), strict=True):
        R = se3.so3_exp(np.radians(angle) * axis) @ R
    return R


def _recolour(run: SavedRun, step: argparse.Namespace) -> SavedRun:
    rgb = [step.red, step.green, step.blue]
    if not all(0 <= value <= 255 for value in rgb):
        raise RunError(f"recolor {' '.join(map(str, rgb))}: R, G and B lie in 0 to 255")
    record = run.find(step.id)
    painted = edits.recolour(run.gaussians, chosen_gaussians(run, record, step), rgb)
    return run.edited(painted, {"edit": "recolor", "id": record.id, "rgb": rgb})


def _label(run: SavedRun, step: argparse.Namespace) -> SavedRun:
    record = run.find(step.id)
    if not is_name(step.name):
        raise RunError(f"label {shown(step.name)}: give at most 1000 characters, all of them of UTF-8")
    objects = edits.relabel(run.objects, record.id, step.name)
    entry: dict[str, Any] = {"edit": "label", "id": record.id, "label": step.name}
    return dataclasses.replace(run, objects=objects, edits=(*run.edits, entry))


def _merge(run: SavedRun, step: argparse.Namespace) -> SavedRun:
    records = [run.find(name) for name in step.ids]
    ids = list(dict.fromkeys(record.id for record in records))
    if len(ids) < 2:
        raise RunError(f"merge {' '.join(step.ids)}: give two objects or more")
    merged = run.edited(edits.merge(run.gaussians, ids), {"edit": "merge", "ids": ids})
    whole = merged_record(records)
    objects = tuple(
        dataclasses.replace(o, **{name: getattr(whole, name) for name in FROM_KEYFRAMES})
        if o.id == whole.id
        else o
        for o in merged.objects
    )
    classifier = run.classifier
    if classifier is not None:
        own = np.isin(classifier.ids, ids)
        classifier = dataclasses.replace(classifier, ids=np.where(own, ids[0], classifier.ids))
    return dataclasses.replace(merged, objects=objects, classifier=classifier)


def _split(run: SavedRun, step: argparse.Namespace) -> SavedRun:
    record = run.find(step.id)
    try:
        gaussians, new = edits.split(run.gaussians, record.id, step.parts, first_new=_unused_id(run))
    except ValueError as error:
        raise RunError(f"--parts {step.parts}: {error}; give 2 or more, up to its Gaussians") from None
    if not new:
        raise RunError(f"{record.name}: is in one piece; --parts N cuts it into N")
    done = run.edited(gaussians, {"edit": "split", "id": record.id, "new": new})
    objects = done.objects
    for number, identifier in enumerate(new, start=2):
        objects = edits.relabel(objects, identifier, f"{record.name} {number}")
    return dataclasses.replace(done, objects=objects)


def _unused_id(run: SavedRun) -> int:
    """Return an id beyond all that the masks, the classifier or an edit ever had."""
    known = [i for record in run.objects for i in (record.id, *record.source_ids)]
    classes = [] if run.classifier is None else [int(i) for i in run.classifier.ids]
    return 1 + max([0, *known, *classes])
