# SPDX-License-Identifier: Apache-2.0
"""Edits of a run with undo and redo, what is selected and what is hidden: all but the page."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ggwarp.editing import actions
from ggwarp.editing.command_line import parse
from ggwarp.editing.progress import Progress, silent
from ggwarp.geometry import se3
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import ObjectRecord, centre_of
from ggwarp.results.saved_run import RunError, SavedRun, next_edit_folder, save_run
from ggwarp.types import Float64
from ggwarp.viewer.picking import Pick, Picker

MOST_VERSIONS = 50
"""Edits that can be undone; arrays that an edit leaves alone are shared between versions."""


@dataclass(frozen=True)
class Version:
    """A state of the run.

    Attributes:
        run: with the map as it is.
        command: what ``ggwarp objects RUN`` would be given to come here from the state before; empty: it is
            as it was read.
    """

    run: SavedRun
    command: str = ""


class EditSession:
    """One user's work on a run.

    Every edit is one of ``ggwarp objects``, carried out by the same code. Nothing is written before
    :meth:`save`, and never over the run that was read.

    Attributes:
        selected: ids of the selected objects, in the order of selection.
        hidden: ids of objects that are not shown; the map has them all the same.
    """

    def __init__(self, run: SavedRun, *, device: Any = "cpu") -> None:
        """``device``: what is rendered on; its kernels are loaded (:mod:`ggwarp.editing.device`)."""
        self._device = device
        self._versions = [Version(run)]
        self._at = 0
        self._saved_at = 0
        self._picker: Picker | None = None
        self._shown: Gaussians | None = None
        self.selected: tuple[int, ...] = ()
        self.hidden: frozenset[int] = frozenset()

    @property
    def run(self) -> SavedRun:
        """The run with the edits so far."""
        return self._versions[self._at].run

    @property
    def original(self) -> SavedRun:
        """The run as it was read, or as far back as can be undone."""
        return self._versions[0].run

    @property
    def commands(self) -> list[str]:
        """The edits so far, as ``ggwarp objects RUN`` would be given them."""
        return [version.command for version in self._versions[1 : self._at + 1]]

    @property
    def undoable(self) -> str:
        """The edit that :meth:`undo` would take back; empty: there is none."""
        return self._versions[self._at].command if self._at else ""

    @property
    def redoable(self) -> str:
        """The edit that :meth:`redo` would do again; empty: there is none."""
        return self._versions[self._at + 1].command if self._at + 1 < len(self._versions) else ""

    @property
    def is_saved(self) -> bool:
        """Whether what there is now was saved, or read."""
        return self._at == self._saved_at

    @property
    def visible(self) -> NDArray[np.bool_]:
        """[n] which of the map's Gaussians are shown."""
        gaussians = self.run.gaussians
        if gaussians.object_ids is None or not self.hidden:
            return np.ones(len(gaussians), bool)
        return ~np.isin(gaussians.object_ids, list(self.hidden))

    def shown(self) -> Gaussians:
        """Return the map without what is hidden."""
        if self._shown is None:
            visible = self.visible
            gaussians = self.run.gaussians
            self._shown = gaussians if visible.all() else gaussians.take(visible)
        return self._shown

    def record(self, object_id: int) -> ObjectRecord:
        """Return what is known of an object.

        Raises:
            RunError: there is none.
        """
        return self.run.find(str(object_id))

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Pick | None:
        """Return what of all that is shown a ray meets; see :meth:`Picker.pick`."""
        if self._picker is None:
            self._picker = Picker(self.shown(), device=self._device)
        return self._picker.pick(origin, direction)

    def select(self, *ids: int, add: bool = False) -> None:
        """Select objects; with ``add`` beside those selected, of which those named again are taken back."""
        kept = tuple(i for i in self.selected if i not in ids) if add else ()
        new = tuple(i for i in ids if not (add and i in self.selected))
        self.selected = kept + new

    def hide(self, *ids: int) -> None:
        """Show objects no more."""
        self._set_hidden(self.hidden | set(ids))

    def isolate(self, *ids: int) -> None:
        """Show these objects alone."""
        everything = self.run.gaussians.object_ids
        self._set_hidden(frozenset() if everything is None else frozenset(np.unique(everything)) - set(ids))

    def show_all(self) -> None:
        """Hide nothing."""
        self._set_hidden(frozenset())

    def remove(self, *, fill: bool = True, progress: Progress = silent) -> None:
        """Take the selected objects out, and fill the holes that they leave."""
        words = ["remove", *self._chosen(), *([] if fill else ["--no-fill"])]
        self.edit(words, progress)

    def move(self, T: ArrayLike, *, fill: bool = False, progress: Progress = silent) -> None:
        """Turn the selected object about its :meth:`grip` and shift it.

        Args:
            T: [4, 4] from its grip's axes as they are (the world's) to where they shall be, grip to grip.
        """
        (identifier,) = self._chosen(1)
        T = np.asarray(T, np.float64)
        turn, shift = se3.so3_log(T[:3, :3]), T[:3, 3]
        words = ["move", identifier, "--translate", *(f"{v:.6f}" for v in shift)]
        if (angle := float(np.degrees(np.linalg.norm(turn)))) > 1e-6:
            words += ["--axis", *(f"{v:.9f}" for v in turn), "--angle", f"{angle:.6f}"]
        self.edit([*words, *(["--fill"] if fill else [])], progress)

    def paint(self, rgb: Sequence[int]) -> None:
        """Paint the selected objects; ``rgb`` 0..255, light and shade are kept."""
        for identifier in self._chosen():
            self.edit(["recolor", identifier, *(str(int(v)) for v in rgb)])

    def name(self, text: str) -> None:
        """Name the selected object; empty takes its name away."""
        (identifier,) = self._chosen(1)
        step = self._step(["label", identifier, "x"])
        step.name = text  # which may be a word that the command line takes for something else
        self._apply(step, ["label", identifier, text])

    def merge(self) -> None:
        """Make the selected objects one, the first selected."""
        self.edit(["merge", *self._chosen()])

    def split(self, parts: int | None = None) -> None:
        """Make the selected object's parts objects: those that are apart, or ``parts`` compact ones."""
        (identifier,) = self._chosen(1)
        self.edit(["split", identifier, *([] if parts is None else ["--parts", str(parts)])])

    def edit(self, words: Sequence[str], progress: Progress = silent) -> None:
        """Do what ``ggwarp objects RUN`` would do with ``words``; what was undone before is forgotten.

        Raises:
            RunError: it cannot be done; nothing has changed.
        """
        self._apply(self._step(words), words, progress)

    def _step(self, words: Sequence[str]) -> argparse.Namespace:
        (step,) = parse([str(self.run.folder), *words])
        step.device = self._device
        return step

    def _apply(self, step: argparse.Namespace, words: Sequence[str], progress: Progress = silent) -> None:
        version = Version(actions.apply(self.run, step, progress), shlex.join(words))
        del self._versions[self._at + 1 :]
        if self._saved_at > self._at:
            self._saved_at = -1
        self._versions.append(version)
        if len(self._versions) > MOST_VERSIONS + 1:
            del self._versions[0]
            self._saved_at -= 1
        self._go_to(len(self._versions) - 1)

    def undo(self) -> str:
        """Take the last edit back, and return it.

        Raises:
            RunError: there is none.
        """
        if not self._at:
            raise RunError("undo: nothing was edited")
        undone = self.undoable
        self._go_to(self._at - 1)
        return undone

    def redo(self) -> str:
        """Do again what was undone last, and return it.

        Raises:
            RunError: there is nothing.
        """
        if not self.redoable:
            raise RunError("redo: nothing was undone")
        self._go_to(self._at + 1)
        return self.undoable

    def save(self, folder: Path | None = None) -> Path:
        """Write what there is as a new run folder (None: RUN-edit1, ...), and return it.

        Raises:
            RunError: it exists.
            OSError: it cannot be written.
        """
        folder = folder or next_edit_folder(self.run.folder)
        save_run(self.run, folder)
        self._saved_at = self._at
        return folder

    def grip(self, object_id: int) -> tuple[Float64, NDArray[np.bool_]]:
        """Return the point [3] that an object is turned about, metres, and [n] the Gaussians that move.

        Raises:
            RunError: there is no such object.
        """
        step = self._step(["move", str(object_id), "--translate", "0", "0", "0"])
        chosen = actions.chosen_gaussians(self.run, self.record(object_id), step)
        return np.array(centre_of(self.run.gaussians.means[chosen])), chosen

    def _chosen(self, count: int | None = None) -> list[str]:
        if not self.selected or (count is not None and len(self.selected) != count):
            wanted = "an object" if count is None else f"{'one object' if count == 1 else count}"
            raise RunError(f"{len(self.selected)} objects are selected; select {wanted}")
        return [str(i) for i in self.selected]

    def _go_to(self, number: int) -> None:
        self._at = number
        there = {record.id for record in self.run.objects}
        self.selected = tuple(i for i in self.selected if i in there)
        self._picker = self._shown = None

    def _set_hidden(self, ids: frozenset[int]) -> None:
        self.hidden = frozenset(int(i) for i in ids)
        self._picker = self._shown = None
