# SPDX-License-Identifier: Apache-2.0
"""The course of a run, as its folder tells it: keyframes, loops, live trajectory, recorded pictures."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.config import ConfigError
from ggwarp.config.presets import load_config
from ggwarp.datasets import DatasetError, FrameReader, is_live_source, open_dataset
from ggwarp.io.guarded import FileError
from ggwarp.io.table import read_table
from ggwarp.io.trajectory import read_tum
from ggwarp.results.saved_run import SavedRun
from ggwarp.types import Float64

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class History:
    """What happened at which pose of a run.

    Attributes:
        indices: the frame's index in its sequence, a row a pose.
        keyframes: rows of the keyframes.
        loops: pairs of rows that a loop joined.
        live: [m, 4, 4] poses as they were reported at the time; none where the folder has none.
    """

    indices: list[int]
    keyframes: list[int] = field(default_factory=list)
    loops: list[tuple[int, int]] = field(default_factory=list)
    live: Float64 = field(default_factory=lambda: np.zeros((0, 4, 4)))


def read_history(run: SavedRun) -> History:
    """Return the course of ``run``; of what its folder lacks or has damaged, nothing."""
    count = len(run.poses)
    try:
        rows = read_table(run.folder / "frames.csv")
        indices = [int(row["index"]) for row in rows]
        row_of = {index: row for row, index in enumerate(indices)}
        loops = [
            (k, row_of[int(row["loop_with"])])
            for k, row in enumerate(rows)
            if row["loop_with"] and int(row["loop_with"]) in row_of
        ]
        keyframes = [k for k, row in enumerate(rows) if row["keyframe"]]
    except (FileError, KeyError, ValueError):
        indices, keyframes, loops = [], [], []
    if len(indices) != count:
        return History(list(range(count)))
    return History(indices, keyframes, loops, _live(run.folder / "trajectory_live.txt"))


def _live(path: Path) -> Float64:
    try:
        return read_tum(path)[1]
    except FileError:
        return np.zeros((0, 4, 4))


class RecordedPictures:
    """The pictures of the recording that a run is of, while it is where it was."""

    def __init__(self, folder: Path) -> None:
        """Open the recording that the ``config.toml`` of ``folder`` names, when it is first asked for."""
        self._folder = folder
        self._reader: FrameReader | None = None
        self._looked = False

    def picture(self, index: int) -> NDArray[np.uint8] | None:
        """Return frame ``index`` [h, w, 3] at the run's size; None where it cannot be read."""
        try:
            reader = self._open()
            return None if reader is None else reader.read(index).rgb
        except (DatasetError, OSError, IndexError) as error:
            log.debug("no picture of frame %d: %s", index, error)
            return None

    def _open(self) -> FrameReader | None:
        if self._looked:
            return self._reader
        self._looked = True
        try:
            config = load_config(self._folder / "config.toml")
            if config.seq is None or is_live_source(config.seq):
                return None
            dataset: Any = open_dataset(
                config.seq,
                data_root=config.data_root(),
                masks="none",
                faults=config.built_in,
                intrinsics=config.intrinsics,
            )
            self._reader = FrameReader(dataset, range(len(dataset)), scale=config.scale or 1.0)
        except (ConfigError, DatasetError, OSError) as error:
            log.info("the recording is not to be had: %s", error)
        return self._reader
