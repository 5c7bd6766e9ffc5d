# SPDX-License-Identifier: Apache-2.0
"""The results of a run, saved part by part: one that fails does not take the others with it."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ggwarp import messages
from ggwarp.console import Display
from ggwarp.map.gaussians import identities
from ggwarp.report.gallery import Gallery
from ggwarp.report.page import write_report
from ggwarp.results import run_folder
from ggwarp.results.checkpoints import FOLDER
from ggwarp.results.metrics import metrics_of
from ggwarp.results.record import RunRecord
from ggwarp.results.renders import RenderWriter
from ggwarp.results.staging import StagedFolder
from ggwarp.types import Frame, Rendered

_NEEDED = {"saving the trajectory", "saving the map"}
"""Without these there is nothing to keep."""

_TABLES = ("metrics.json", "frames.csv", "object_scores.csv")
"""What is written anew once pictures have been compared."""

_ROOM_FOR_TABLES = 1 << 14
"""Bytes that they may grow by then, apart from what grows with them."""


class Saver:
    """Writes a run's results; a part that fails is said, and kept in the record.

    Attributes:
        metrics: the figures, as they were saved last.
        moved: whether all of the run is elsewhere, as its own place could not take it.
    """

    def __init__(
        self,
        record: RunRecord,
        folder: StagedFolder,
        display: Display,
        started: float,
        begin: Callable[[Path], None] = lambda folder: None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Prepare to save.

        Args:
            started: time.perf_counter() at the command's start.
            begin: writes what the folder has from the start into another one.
            stopped: asked while the user's answer is waited for, whether not to.
        """
        self.metrics: dict[str, Any] = {}
        self.moved = False
        self._record, self._folder, self._display, self._started = record, folder, display, started
        self._begin, self._stopped, self._target = begin, stopped, folder.target
        self._gaussians: int | None = None
        self._missing: set[str] = set()  # parts that no folder has
        self._failed: set[str] = set()
        self._refused = False  # by the file system
        self._told: set[tuple[int | None, Path]] = set()

    @property
    def folder(self) -> Path:
        """Where the results are."""
        return self._folder.path

    @property
    def table_bytes(self) -> int:
        """Bytes of the tables and metrics, as they were saved last."""
        return sum((self.folder / name).stat().st_size for name in _TABLES if (self.folder / name).is_file())

    @property
    def record(self) -> RunRecord:
        """What the run has gathered."""
        return self._record

    @property
    def where(self) -> str:
        """Where the results are, as the user is told."""
        if _NEEDED <= self._missing:
            return "nowhere: no folder could take them"
        return f"{self.folder}, as {self._target} could not take it" if self.moved else str(self.folder)

    def judge(self, far: float | None) -> None:
        """Say and keep where the run has tracked or mapped nothing, though no part of it failed.

        Args:
            far: metres beyond which depth is not used; None: there is no depth.
        """
        if cause := messages.total_failure(self._record.reports, self._record.plan, far):
            self._display.close()
            self._record.failures.append(cause)
            messages.say_error(cause)

    def warn_of_truth(self) -> None:
        """Say which convention the truth seems to be written by, where it is another one."""
        if doubt := self.metrics.get("truth_doubt"):
            self._display.warn(doubt)

    @property
    def outcome(self) -> str:
        """How the saving of a run that was neither stopped nor failed went."""
        count = len(self._record.failures)
        if count and not self.moved:
            return f"{count} part{'s' * (count > 1)} failed; the rest is in {self.where}"
        return f"{'saved' if self.moved else 'results'} in {self.where}"

    def save(self, slam: run_folder.System) -> None:
        """Write the run and put it where it belongs.

        Where the file system refuses a part, all of the run is written elsewhere: into the temporary folder
        or the current one, and on a terminal where the user says. If no folder takes all of it, an earlier
        run stays in its place, and what there is of this one is kept beside it.
        """
        self._missing = self._write(slam)
        if self._missing and self._refused and self._save_elsewhere(slam):
            return
        if self._missing and self._folder.replaces_a_run:
            self._display.warn(f"the earlier run in {self._folder.target} stays, as this one is not whole")
        elif self.attempt("moving the run to its place", self._folder.publish):
            return
        # Under its own name the next run does not take it for what a killed one left.
        if not self.attempt("moving what was saved", self._folder.keep_apart) and not self._missing:
            self._save_elsewhere(slam)

    def _write(self, slam: run_folder.System) -> set[str]:
        """Write every part into the folder of now; return those that failed."""
        self._failed = set()
        self._save_system(slam)
        self.save_tables()
        return self._failed

    def _save_elsewhere(self, slam: run_folder.System) -> bool:
        """Write the run into other folders until one has taken all of it; return whether one has."""
        first, kept = self._folder, None
        for parent in _other_places():
            folder = _folder_in(parent, self._target.name)
            if folder is not None and self._save_in(slam, folder, instead_of=first):
                kept = folder
                break
            if folder is not None:
                with contextlib.suppress(OSError):  # it may have something
                    folder.target.rmdir()
        state = "nowhere yet" if kept is None else f"in {kept.path}"
        question = f"{self._target} cannot take the run: it is {state}. Another folder (empty: leave it):"
        while answer := self._display.ask(question, self._stopped):
            try:
                folder = StagedFolder(Path(answer).expanduser(), self._record.sequence)
            except OSError as error:
                self._display.warn(f"{answer}: {error.strerror}")
                continue
            if self._save_in(slam, folder, instead_of=kept or first):
                if kept is not None:
                    shutil.rmtree(kept.path, ignore_errors=True)
                kept = folder
                break
        self._folder = kept or first
        if kept is not None:
            self.moved, self._missing = True, set()
            with contextlib.suppress(OSError):
                shutil.copytree(first.path / FOLDER, kept.path / FOLDER)
            first.discard(whole=True)
        return self.moved

    def _save_in(self, slam: run_folder.System, folder: StagedFolder, *, instead_of: StagedFolder) -> bool:
        """Write the run into ``folder``; return whether it has taken all of it.

        What it did not take all of stays where it has something that ``instead_of`` lacks.
        """
        self._folder = folder

        def begin() -> None:
            folder.create()
            self._begin(folder.path)

        missing = self._write(slam) if self.attempt("making another folder", begin) else _NEEDED
        if not missing and self.attempt("moving the run to its place", folder.publish):
            return True
        if self._missing & _NEEDED - missing and self.attempt("moving what was saved", folder.publish):
            self._display.warn(f"what {instead_of.target} lacks is in {folder.path}")
            self._missing &= missing
        else:
            folder.discard(whole=True)
        self._folder = instead_of
        return False

    def _save_system(self, slam: run_folder.System) -> None:
        """Write the trajectory, and the map with its objects and what tells them apart."""
        folder, names = self._folder.path, self._record.class_names
        # The trajectory first: where the device has failed, the map cannot be had.
        self.attempt("saving the trajectory", lambda: run_folder.write_trajectories(folder, self._record))
        self.attempt("saving the map", lambda: self._save_map(slam))
        self.attempt("saving the objects", lambda: run_folder.write_objects(folder, slam.objects(names)))
        self.attempt(
            "saving the classifier", lambda: run_folder.write_identities(folder, slam.linear_classifier())
        )

    def save_tables(self) -> None:
        """Write the tables of frames and objects, and the metrics."""
        record, folder = self._record, self._folder.path
        self.attempt("saving the table of frames", lambda: run_folder.write_frames(folder, record))
        self.attempt("saving the table of objects", lambda: run_folder.write_object_scores(folder, record))
        self.attempt("saving the metrics", self._save_metrics)  # last: they tell what has failed

    def write_report(self) -> None:
        """Write ``report.html`` from what is saved; the metrics say where that fails."""
        if self._missing >= _NEEDED:
            return
        if not self.attempt("writing the report", lambda: write_report(self.folder)):
            self.attempt("saving the metrics", self._save_metrics)

    def attempt(self, what: str, work: Callable[[], None]) -> bool:
        """Do a part of the run that may fail alone; return whether it succeeded."""
        try:
            work()
        except Exception as error:
            self._failed.add(what)
            self._refused |= isinstance(error, OSError)
            self.failed(f"{what} failed", error)
            return False
        return True

    def failed(self, what: str, reason: BaseException) -> None:
        """Say that a part of the run failed, and keep it in the record."""
        self._folder.name_target(reason)
        self._display.close()
        # Of the parts that a folder refuses for the same reason, the first is enough.
        same = (getattr(reason, "errno", None), self._folder.target)
        self._record.failures.append(messages.explain(what, reason, silent=same in self._told))
        if isinstance(reason, OSError):
            self._told.add(same)

    def _save_map(self, slam: run_folder.System) -> None:
        folder, reports = self._folder.path, self._record.reports
        self._gaussians = sum(len(part) for part in slam.map_parts())
        run_folder.write_map(folder, slam.map_parts)
        self.attempt(
            "saving the first view",
            lambda: run_folder.write_first_view(
                folder, run_folder.outline(slam.map_parts), slam.camera, reports
            ),
        )

    def _save_metrics(self) -> None:
        wall_s = time.perf_counter() - self._started
        self._record.interrupted = self._stopped()
        self._record.warnings = list(self._display.warnings)
        self.metrics = metrics_of(self._record, wall_s=wall_s, gaussians=self._gaussians)
        run_folder.write_metrics(self._folder.path, self.metrics)


class ViewSaver:
    """Writes the views of some frames as pictures; where that fails it is said, and no more are written."""

    def __init__(self, saver: Saver, every: int | None, parts: run_folder.Parts) -> None:
        """Prepare to be given views.

        Args:
            every: so many of the run's frames have renders; None or 0: none has.
            parts: gives the map, for the features' basis.
        """
        indices = [r.index for r in saver.record.reports]
        self._saver, self._parts = saver, parts
        self._rendered = set(indices[::every]) if every else set()
        self._gallery = Gallery(indices)
        self._writer: RenderWriter | None = None

    def save(self, frame: Frame, view: Rendered, psnr: float | None) -> None:
        """Write the view of ``frame``, if it is one of those; keep what people may want to look at."""
        self._gallery.add(frame, view, psnr)
        if frame.index in self._rendered and not self._saver.attempt(
            "saving renders", lambda: self._write(frame.index, view)
        ):
            self._rendered = set()

    def finish(self) -> None:
        """Write what was kept."""
        self._saver.attempt("saving pictures", lambda: self._gallery.write(self._saver.folder))

    def _write(self, index: int, view: Rendered) -> None:
        if self._writer is None:
            self._writer = RenderWriter(self._saver.folder / "renders", identities(self._parts()))
        self._writer.write(index, view)


def _other_places() -> Iterator[Path]:
    """Yield where a run goes that its own place cannot take."""
    with contextlib.suppress(OSError):
        yield Path(tempfile.gettempdir())
    yield Path()


def _folder_in(parent: Path, name: str) -> StagedFolder | None:
    """Return a new folder in ``parent``; None: none can be made there."""
    with contextlib.suppress(OSError):
        return StagedFolder(Path(tempfile.mkdtemp(prefix=f"ggwarp-{name}-", dir=parent)), name)
    return None
