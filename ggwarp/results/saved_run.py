# SPDX-License-Identifier: Apache-2.0
"""A run folder read back: the map, its objects and what is needed to render it."""

from __future__ import annotations

import dataclasses
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ggwarp.geometry.camera import Camera
from ggwarp.geometry.upright import Up
from ggwarp.io.camera import read_camera, write_camera
from ggwarp.io.guarded import OBJECTS, FileError, read_json
from ggwarp.io.json import write_json
from ggwarp.io.ply import read_ply, write_ply
from ggwarp.io.printable import printable, shown
from ggwarp.io.suggestion import did_you_mean
from ggwarp.io.trajectory import read_tum
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import ObjectRecord, inventory, refreshed
from ggwarp.objects.linear_classifier import LinearClassifier, read_classifier, write_classifier
from ggwarp.results.scene_view import FILE, SceneView, describe_view, read_view
from ggwarp.types import Float64

_NEEDED = ("map.ply", "camera.json", "trajectory.txt")
_COPIED = ("config.toml", "trajectory.txt", "trajectory_gt.txt", "view.json")


class RunError(ValueError):
    """A run folder or an edit cannot be used: one line with what is wrong and the remedy."""


@dataclass(frozen=True)
class SavedRun:
    """What a run left that views, renders and edits need.

    Attributes:
        folder: where it was read from.
        gaussians: the map.
        objects: the map's objects, by id; none where the run learnt none.
        camera: of the run's images.
        poses: [n, 4, 4] camera-to-world, one a frame of the run.
        classifier: what tells identities apart; None where the run learnt none.
        edits: what was done to the map since the run, in order.
    """

    folder: Path
    gaussians: Gaussians
    objects: tuple[ObjectRecord, ...]
    camera: Camera
    poses: Float64
    classifier: LinearClassifier | None = None
    edits: tuple[dict[str, Any], ...] = ()

    def find(self, name: str) -> ObjectRecord:
        """Return the object that ``name`` means: an id, else a label, else a class, else words of its name.

        Raises:
            RunError: no object, or more than one.
        """
        fold, words = name.casefold(), _words(name)
        for matches in (
            [o for o in self.objects if str(o.id) == name],
            [o for o in self.objects if o.label is not None and o.label.casefold() == fold],
            [o for o in self.objects if o.class_name is not None and o.class_name.casefold() == fold],
            [o for o in self.objects if words and words <= _words(o.name)],
        ):
            if len(matches) == 1:
                return matches[0]
            if matches:
                ids = ", ".join(f"{o.id} ({printable(o.name)})" for o in matches)
                raise RunError(f"{name}: {len(matches)} objects have this name; give one of the ids {ids}")
        near = did_you_mean(name, [o.name for o in self.objects])
        raise RunError(f"{name}: {self.folder} has no such object{near}; `list` shows those there are")

    def scene_view(self, up: Up | None = None) -> SceneView:
        """Return how the map is shown: as ``view.json`` says, or estimated where there is none.

        Args:
            up: where it is known better, as by ``--up``.

        Raises:
            RunError: ``view.json`` is damaged.
        """
        if up is not None or not (self.folder / FILE).is_file():
            return describe_view(self.gaussians, self.camera, self.poses, up)
        try:
            return read_view(self.folder)
        except FileError as error:
            raise RunError(str(error)) from None

    def edited(self, gaussians: Gaussians, edit: dict[str, Any]) -> SavedRun:
        """Return this run with ``gaussians`` for a map, its objects described anew, and ``edit`` recorded."""
        g = gaussians
        objects = refreshed(list(self.objects), g.means, g.colours, g.object_ids, g.extents())
        return dataclasses.replace(
            self, gaussians=gaussians, objects=tuple(objects), edits=(*self.edits, edit)
        )


def load_run(folder: str | Path) -> SavedRun:
    """Read what any run left: with or without objects, of the command or of :meth:`ggwarp.Slam.save`.

    Raises:
        RunError: it is no run folder, or a file is missing or damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RunError(f"{folder}: no such folder; give a run folder, such as runs/latest")
    for name in _NEEDED:
        if not (folder / name).is_file():
            raise RunError(f"{folder}: has no {name}, so it is no run folder of this version")
    try:
        gaussians = read_ply(folder / "map.ply")
        camera = read_camera(folder / "camera.json")
        _, poses = read_tum(folder / "trajectory.txt")
        file = folder / "classifier.npz"
        classifier = read_classifier(file) if file.is_file() else None
    except ValueError as error:
        raise RunError(str(error)) from None
    file = folder / "objects.json"
    if file.is_file():
        objects, edits = _read_objects(file)
    else:
        g = gaussians
        objects = tuple(inventory(g.means, g.colours, g.object_ids, extents=g.extents()))
        edits = ()
    return SavedRun(folder, gaussians, objects, camera, poses, classifier, edits)


def save_run(run: SavedRun, folder: str | Path) -> None:
    """Write ``run`` as a new run folder, with ``edits`` and what they were applied to in ``objects.json``.

    Metrics, renders and the table of frames are of the unedited map: they are not copied.

    Raises:
        RunError: ``folder`` exists.
        OSError: it cannot be written.
    """
    folder = Path(folder)
    if folder.exists():
        raise RunError(f"{folder}: exists already, and nothing is overwritten; choose another --out")
    folder.mkdir(parents=True)
    for name in _COPIED:
        if (run.folder / name).is_file():
            shutil.copyfile(run.folder / name, folder / name)
    write_camera(folder / "camera.json", run.camera)
    write_ply(folder / "map.ply", run.gaussians)
    if run.classifier is not None:
        write_classifier(folder / "classifier.npz", run.classifier)
    entries = [record.to_json() for record in run.objects]
    source = str(run.folder.resolve())
    write_json(folder / "objects.json", {"objects": entries, "edited_from": source, "edits": run.edits})


def next_edit_folder(folder: Path) -> Path:
    """Return the first of FOLDER-edit1, FOLDER-edit2, ... that is not there; of an edit, the next."""
    folder = folder.resolve()
    stem, number = re.sub(r"-edit\d+$", "", folder.name), 1
    while (found := folder.with_name(f"{stem}-edit{number}")).exists():
        number += 1
    return found


def _read_objects(path: Path) -> tuple[tuple[ObjectRecord, ...], tuple[dict[str, Any], ...]]:
    try:
        values = read_json(path, OBJECTS)
    except FileError as error:
        raise RunError(f"{error}; not as this version writes it: run the sequence again") from None
    try:
        entries, edits = values["objects"], values.get("edits", [])
        if not isinstance(entries, list) or not isinstance(edits, list):
            raise ValueError("objects and edits are no lists")
        for edit in edits:
            if not isinstance(edit, dict) or not isinstance(edit.get("edit"), str) or not _shallow(edit):
                raise ValueError(f"an edit is {shown(edit)}")
        return tuple(ObjectRecord.from_json(entry) for entry in entries), tuple(edits)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        reason = str(error) if type(error) is ValueError else "the list of objects is missing"
        raise RunError(
            f"{printable(str(path))}: is not as this version writes it ({reason}); run the sequence again"
        ) from None


def _words(name: str) -> set[str]:
    return set(re.findall(r"[^\W_]+", name.casefold()))


def _shallow(value: Any, most: int = 8) -> bool:
    """Return whether ``value`` is nested at most so many times: deeper, it could not be written again."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return most >= 0 and all(_shallow(v, most - 1) for v in inner)
