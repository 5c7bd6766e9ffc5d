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


class Saver:
    """Writes a run's results; a part that fails is said, and kept in the record.

    Attributes:
        metrics: the figures, as they were saved last.
    """

    def __init__(self, record: RunRecord, folder: Path, display: Display, started: float) -> None:
        """``started``: time.perf_counter() at the command's start."""
        self.metrics: dict[str, Any] = {}
        self._record, self._folder, self._display, self._started = record, folder, display, started
        self._gaussians: int | None = None

    def save_system(self, slam: run_folder.System) -> None:
        """Write the trajectory, and the map with its objects and what tells them apart."""
        folder, names = self._folder, self._record.class_names
        # The trajectory first: where the device has failed, the map cannot be had.
        self.attempt("saving the trajectory", lambda: run_folder.write_trajectories(folder, self._record))
        self.attempt("saving the map", lambda: self._save_map(slam))
        self.attempt("saving the objects", lambda: run_folder.write_objects(folder, slam.objects(names)))
        self.attempt(
            "saving the classifier", lambda: run_folder.write_identities(folder, slam.linear_classifier())
        )

    def save_tables(self) -> None:
        """Write the tables of frames and objects, and the metrics."""
        record, folder = self._record, self._folder
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
        self._display.close()
        self._record.failures.append(messages.explain(what, reason))

    def _save_map(self, slam: run_folder.System) -> None:
        arrays = slam.map_arrays()
        self._gaussians = len(arrays)
        run_folder.write_map(self._folder, arrays)

    def _save_metrics(self) -> None:
        wall_s = time.perf_counter() - self._started
        self.metrics = metrics_of(self._record, wall_s=wall_s, gaussians=self._gaussians)
        run_folder.write_metrics(self._folder, self.metrics)
