# SPDX-License-Identifier: Apache-2.0
"""A run's checkpoints: when one is due, what it holds, and how a run goes on from one.

Frames of a live source cannot be read again, so that such a run cannot go on: it saves its results so far in
their stead.
"""

from __future__ import annotations

import dataclasses
import os
import time
from pathlib import Path

import ggwarp
from ggwarp.config import CheckpointInterval, ConfigError, ResumedRun, RunConfig
from ggwarp.config.earlier_run import map_checksum
from ggwarp.console import Display
from ggwarp.datasets import DatasetError, FrameReader
from ggwarp.io.toml import toml_text
from ggwarp.pipeline.runner import Snapshot
from ggwarp.pipeline.slam import Slam
from ggwarp.pipeline.tracked_frame import TrackedFrame
from ggwarp.results.checkpoints import save_checkpoint
from ggwarp.results.record import RunRecord
from ggwarp.results.run_folder import write_system
from ggwarp.results.staging import StagedFolder
from ggwarp.runtime.state import State, StateError, pack, restored, unpack

_MOST_TIME = 0.02
"""Share of a run's time that checkpoints by the clock may take: after a slow one, the next comes later."""

_NOT_OURS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError)
"""What is raised by state that another version has written."""

KEPT_OF_THE_RECORD = ("truth", "skipped", "warnings", "loop_s", "refine_iterations", "refine_s")
"""Fields of a run's record; the reports are the system's, all else is of the start or the end of a run."""


class Checkpoints:
    """Writes a run's checkpoints, or a live one's results; what cannot be written is said, and it goes on."""

    def __init__(
        self,
        interval: CheckpointInterval,
        slam: Slam,
        config: RunConfig,
        folder: StagedFolder,
        reader: FrameReader,
        record: RunRecord,
        display: Display,
        started: float,
    ) -> None:
        """Prepare to write.

        Args:
            config: resolved, of the whole run.
            started: time.perf_counter() at the command's start, less what the run took before.
        """
        self._is_live = reader.is_live
        if reader.is_live and not interval.is_off:
            display.note(
                "frames of a live source cannot be read again: not checkpoints, but the map and the "
                "trajectory so far are saved on the way"
            )
        self._interval, self._slam = interval, slam
        self._folder, self._record, self._display = folder, record, display
        self._config = toml_text(dataclasses.replace(config, out=None))
        self._camera = dataclasses.asdict(reader.camera)
        self._earlier = None
        if (earlier := slam.earlier) is not None:
            folder_of_it = os.path.realpath(earlier.folder)
            self._earlier = {"folder": folder_of_it, "checksum": map_checksum(earlier)}
        self._started = started
        self._steps = self._last_step = 0
        self._last_time, self._cost_s = time.perf_counter(), 0.0
        self._written: tuple[int, int] | None = None
        self._failing = False

    def due(self) -> bool:
        """Return whether one is due; ask after every frame, and after every iteration of a refinement."""
        every, steps = self._interval, self._steps
        self._steps += 1
        if not self._slam.has_state:
            return False
        if every.frames:
            due = steps - self._last_step >= every.frames
        else:
            wait = max(every.seconds, self._cost_s / _MOST_TIME)
            due = every.seconds > 0.0 and time.perf_counter() - self._last_time >= wait
        if due:
            self._last_step, self._last_time = steps, time.perf_counter()
        return due

    def write(self, snapshot: Snapshot) -> None:
        """Write a checkpoint of ``snapshot`` and of what the record has by now; or a live run's results."""
        started = time.perf_counter()
        try:
            if self._is_live:
                write_system(self._folder.path, self._slam, self._record.class_names)
            elif snapshot.failure is not None:
                raise snapshot.failure
            else:
                save_checkpoint(self._folder.path, self._tree(snapshot))
        except Exception as error:  # whatever it is, the run is worth more
            self._folder.name_target(error)
            if not self._failing:
                where = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
                why = getattr(error, "strerror", None) or str(error) or type(error).__name__
                what = "not saved so far" if self._is_live else "no checkpoint"
                self._display.warn(f"{what}: {where}{why}; the run goes on")
            self._failing = True
        else:
            self._written, self._failing = self._progress, False
        self._last_time = time.perf_counter()
        self._cost_s = self._last_time - started

    def _tree(self, snapshot: Snapshot) -> State:
        self._record.warnings = list(self._display.warnings)
        record = {name: pack(getattr(self._record, name)) for name in KEPT_OF_THE_RECORD}
        return {
            "ggwarp": ggwarp.__version__,
            "config": self._config,
            "target": self._folder.target.name,
            "linked": self._folder.linked,
            "camera": self._camera,
            "earlier": self._earlier,
            "record": record | {"frames": self._progress[0], "wall_s": time.perf_counter() - self._started},
            "tracking": snapshot.tracking,
            "mapping": snapshot.mapping,
            "pending": pack(snapshot.pending),
        }

    def end(self) -> None:
        """Write no more: a step was broken off, and the system is between two states."""
        self._interval = CheckpointInterval()

    def write_now(self) -> None:
        """Write one of the system as it is, between two frames, unless there is one; not after a failure."""
        off = self._interval.is_off or not self._slam.has_state or self._record.failure is not None
        if not off and self._written != self._progress:
            self.write(Snapshot().take_tracking(self._slam).take_mapping(self._slam))

    @property
    def _progress(self) -> tuple[int, int]:
        record = self._record
        return len(record.reports) + len(record.skipped), record.refine_iterations


def staged_folder(config: RunConfig, resumed: ResumedRun | None, name: str) -> StagedFolder:
    """Return the folder that a run of the sequence ``name`` writes into.

    Raises:
        OSError: see :class:`ggwarp.results.staging.StagedFolder`.
    """
    if resumed is None:
        return StagedFolder(config.out, name)
    out = config.out or resumed.target
    same = os.path.realpath(out) == os.path.realpath(resumed.target)
    adopted = Path(os.path.realpath(resumed.folder)) if same and resumed.adopted else None
    return StagedFolder(out, name, adopted=adopted, linked=same and resumed.linked)


def go_on(
    resumed: ResumedRun,
    config: RunConfig,
    slam: Slam,
    record: RunRecord,
    reader: FrameReader,
    display: Display,
) -> list[TrackedFrame]:
    """Bring ``slam`` and ``record`` to where the run was.

    Args:
        config: of the whole run.
        reader: of all frames of the run, those done before first.

    Returns:
        The frames that were tracked, but not mapped.

    Raises:
        ConfigError: the sequence or the frames are others, or the checkpoint does not fit.
        DatasetError: a keyframe's frame cannot be read any more.
    """
    for fault in resumed.faults:
        display.warn(f"{fault}; the checkpoint before it is taken")
    pending = _restore(resumed, slam, record, reader)
    now = [line for line in display.warnings if line not in record.warnings]
    display.warnings[:] = [*record.warnings, *now]
    done = sorted([*(r.index for r in record.reports), *record.skipped, *(t.frame.index for t in pending)])
    if list(reader.indices[: len(done)]) != done:
        raise ConfigError(
            f"--frames {config.frames}: the run has {len(done)} frames behind it, {done[0]} to {done[-1]}; "
            "give the frames that it began with, or more"
        )
    display.note(f"going on after {len(done)} of {len(reader)} frames, from {resumed.folder}")
    if config.device != resumed.config.device:
        display.note(f"on {config.device}, not {resumed.config.device}: results differ in their last bits")
    return pending


def _restore(resumed: ResumedRun, slam: Slam, record: RunRecord, reader: FrameReader) -> list[TrackedFrame]:
    what, tree = f"--resume {resumed.folder}", resumed.tree
    try:
        if tree["camera"] != dataclasses.asdict(reader.camera):
            raise StateError("the sequence's camera is not the one that it was")
        for name in KEPT_OF_THE_RECORD:
            setattr(record, name, restored(getattr(record, name), tree["record"][name], reader.read))
        slam.restore(tree["tracking"], tree["mapping"], reader.read)
        record.reports = list(slam.reports)
        pending = unpack(tree["pending"], reader.read)
        tree.clear()  # a map is not kept twice
        return pending
    except StateError as error:
        raise ConfigError(f"{what}: {error}; give the recording that it began with") from None
    except DatasetError:
        raise
    except _NOT_OURS as error:
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(f"{what}: its checkpoint is not as this version writes it ({reason})") from None
