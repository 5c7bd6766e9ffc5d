# SPDX-License-Identifier: Apache-2.0
"""The results of a run, saved part by part: one that fails does not take the others with it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ggwarp import messages
from ggwarp.console import Display
from ggwarp.results import run_folder
from ggwarp.results.metrics import metrics_of
from ggwarp.results.record import RunRecord
from ggwarp.results.staging import StagedFolder


class Saver:
    """Writes a run's results; a part that fails is said, and kept in the record.

    Attributes:
        metrics: the figures, as they were saved last.
    """

    def __init__(self, record: RunRecord, folder: StagedFolder, display: Display, started: float) -> None:
        """``started``: time.perf_counter() at the command's start."""
        self.metrics: dict[str, Any] = {}
        self._record, self._folder, self._display, self._started = record, folder, display, started
        self._gaussians: int | None = None

    @property
    def folder(self) -> Path:
        """Where the results are."""
        return self._folder.path

    def save(self, slam: run_folder.System) -> None:
        """Write the run and put it where it belongs.

        Where a part cannot be written, an earlier run stays in its place, and the rest is kept beside it.
        """
        before = len(self._record.failures)
        self._save_system(slam)
        self.save_tables()
        if len(self._record.failures) > before and self._folder.replaces_a_run:
            self._display.warn(f"the earlier run in {self._folder.target} stays, as this one is not whole")
            self.attempt("moving what was saved", self._folder.keep_apart)
        elif not self.attempt("moving the run to its place", self._folder.publish):
            # Under its own name the next run does not take it for what a killed one left.
            self.attempt("moving what was saved", self._folder.keep_apart)

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

    def attempt(self, what: str, work: Callable[[], None]) -> bool:
        """Do a part of the run that may fail alone; return whether it succeeded."""
        try:
            work()
        except Exception as error:
            self.failed(f"{what} failed", error)
            return False
        return True

    def failed(self, what: str, reason: BaseException) -> None:
        """Say that a part of the run failed, and keep it in the record."""
        self._folder.name_target(reason)
        self._display.close()
        self._record.failures.append(messages.explain(what, reason))

    def _save_map(self, slam: run_folder.System) -> None:
        arrays = slam.map_arrays()
        self._gaussians = len(arrays)
        run_folder.write_map(self._folder.path, arrays)

    def _save_metrics(self) -> None:
        wall_s = time.perf_counter() - self._started
        self.metrics = metrics_of(self._record, wall_s=wall_s, gaussians=self._gaussians)
        run_folder.write_metrics(self._folder.path, self.metrics)
