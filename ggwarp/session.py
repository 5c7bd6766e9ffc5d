# SPDX-License-Identifier: Apache-2.0
"""A run from its data to the saved results."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import signal
import time
from pathlib import Path

import ggwarp
from ggwarp import messages
from ggwarp.checkpointing import Checkpoints, go_on, staged_folder
from ggwarp.config import CheckpointInterval, ResumedRun, RunConfig, frame_indices, resolve_config
from ggwarp.console import Display
from ggwarp.datasets import BadFrame, DatasetError, FrameReader, WithoutDepth, open_dataset
from ggwarp.datasets.base import dropped_frames, is_live
from ggwarp.datasets.kept_frames import KeptFrames
from ggwarp.datasets.plan.sequence_plan import plan_sequence
from ggwarp.evaluation.evaluate import FrameScore
from ggwarp.evaluation.evaluate import evaluate as compare
from ggwarp.evaluation.lpips import open_lpips
from ggwarp.interruption import Interruption
from ggwarp.io.camera import write_camera
from ggwarp.io.toml import write_toml
from ggwarp.pipeline.loops.localisation import NotFoundError
from ggwarp.pipeline.runner import SideError, Snapshot, run_steps
from ggwarp.pipeline.tracked_frame import TrackedFrame
from ggwarp.preparation import build_system, load_kernels, new_record, works_concurrently
from ggwarp.results.checkpoints import kept_in
from ggwarp.results.metrics import measured
from ggwarp.results.saved_run import SavedRun
from ggwarp.results.staging import StagedFolder
from ggwarp.runtime import loading
from ggwarp.runtime.memory import image_budget
from ggwarp.saving import Saver, ViewSaver
from ggwarp.types import Frame, Rendered, StepReport, Verdict
from ggwarp.viewer.watching import NoViewer, RunViewer

DONE, FAILED = 0, 1
"""Exit codes."""


class Session:
    """One run, from its data to the saved results.

    Attributes:
        config: of the run; after :meth:`open`, with nothing left open.
        record: what the run has gathered so far, the map aside.
        folder: where the results go; None before :meth:`open`.
    """

    def __init__(
        self,
        config: RunConfig,
        display: Display,
        interruption: Interruption | None = None,
        *,
        started: float | None = None,
        interval: CheckpointInterval | None = None,
        resumed: ResumedRun | None = None,
        earlier: SavedRun | None = None,
        viewer: RunViewer | None = None,
    ) -> None:
        """Make a session that has done nothing yet.

        Args:
            config: checked, see :func:`ggwarp.config.check`.
            interruption: tells of signals; None: they are the caller's.
            started: time.perf_counter() at the command's start; None: now.
            interval: how often a checkpoint is written; None: never.
            resumed: the run to go on with, whose ``config`` is like it; None: a new one.
            earlier: the run in whose map it begins; None: with an empty map.
            viewer: shows the run while it goes on; None: nobody looks.
        """
        self.config = config
        self.folder: StagedFolder | None = None
        self._started = time.perf_counter() if started is None else started
        self._interval, self._display = interval or CheckpointInterval(), display
        self._resumed, self._earlier = resumed, earlier
        self._viewer: RunViewer = viewer or NoViewer()
        self._interruption = interruption or Interruption()

    def run(self) -> int:
        """Run it and return the exit code: 0, 1 (failed on the way), or that of the signal.

        Raises:
            ConfigError, DatasetError, NotFoundError, OSError: it cannot be done as it is asked for.
        """
        try:
            self.open()
            self.prepare()
            self.track_and_map()
            self.refine()
            self.save()
        except BaseException as error:
            if self.folder is not None:
                self.folder.name_target(error)
                if (kept := self.folder.discard()) is not None:
                    self._display.warn(kept_in(kept))
            raise
        self.evaluate()
        self._saver.write_report()
        return self.show()

    def open(self) -> None:
        """Find the data, resolve the configuration for it, and look at where the results shall go."""
        asked, display = self.config, self._display
        display.note(f"ggwarp {ggwarp.__version__}: {asked.seq}, preset {asked.preset}")
        loading.init_quietly()
        seq = asked.seq
        assert seq is not None, "check() has seen to it"
        dataset = open_dataset(
            seq,
            data_root=asked.data_root(),
            masks=asked.mask_choice,
            faults=asked.built_in,
            intrinsics=asked.intrinsics,
        )
        if not len(dataset):
            raise DatasetError(f"{seq}: the sequence is empty")
        self.config = config = resolve_config(asked, dataset, earlier=self._earlier)
        self._dataset = WithoutDepth(dataset) if config.slam.mono else dataset
        self._indices = frame_indices(config.frames, len(dataset))
        self._name = seq if dataset.kind == "synthetic" else dataset.name
        self.folder = staged_folder(config, self._resumed, self._name)
        plan = plan_sequence(self._dataset, self._indices, tracked_masks=config.slam.masks_kind == "tracked")
        self._plan = plan.to_json() | ({"start_from": str(self._earlier.folder)} if self._earlier else {})
        messages.introduce(display, plan, messages.introduction(asked, config, dataset, len(self._indices)))

    def prepare(self) -> None:
        """Build the system, make the run folder and load the kernels."""
        config, dataset, folder = self.config, self._dataset, self.folder
        assert folder is not None, "open() comes first"
        scale, budget = config.scale or 1.0, image_budget(config.device, config.memory)
        self._reader = FrameReader(dataset, self._indices, scale=scale, stopped=lambda: self._stopped)
        self._kept = KeptFrames(dataset, scale=scale, budget=budget, stopped=lambda: self._stopped)
        self._frames = self._reader if self._resumed is None else self._reader.after(self._resumed.done)
        self._slam = build_system(
            config, self._frames, budget - self._kept.room, folder.nearest, self._display, self._earlier
        )
        if reason := self._slam.loops.stay_open:
            self._display.note(f"loops stay open: {reason}")
        self._concurrent = works_concurrently(config, self._slam)
        self.record = new_record(self._name, dataset, config, self._plan)
        self._pending: list[TrackedFrame] = []
        if self._resumed is not None:
            self._pending = go_on(self._resumed, config, self._slam, self.record, self._reader, self._display)
            self._started -= self._resumed.wall_s
        for left, kept in folder.create().items():  # nothing is refused any more
            self._display.note(messages.left_by_a_killed_run(left, kept_in(kept) if kept else ""))
        self._begin(folder.path)
        load_kernels(config.device, self._display)
        self._viewer.begin(self._slam, folder.target)
        record, display, started = self.record, self._display, self._started
        self._checkpoints = Checkpoints(
            self._interval, self._slam, config, folder, self._reader, record, display, started
        )
        self._saver = Saver(record, folder, display, started, self._begin, lambda: self._stopped)

    def track_and_map(self) -> None:
        """Process the frames; a failure of either side ends the loop and is kept in the record.

        Raises:
            DatasetError: no frame could be used. NotFoundError: none was found in an earlier run's map.
            KeyboardInterrupt: it was interrupted before the first one.
        """
        reader, record = self._frames, self.record
        self._interruption.at_once = False
        self._display.stage("frames", None if is_live(self._dataset) else len(self._pending) + len(reader))
        self._loop_started = time.perf_counter() - record.loop_s
        try:
            with self._interruption.breakable(), reader:
                steps = run_steps(
                    self._slam,
                    reader,
                    concurrent=self._concurrent,
                    stopped=lambda: self._stopped,
                    snapshot_due=self._checkpoints.due,
                    pending=self._pending,
                )
                for item, step in steps:
                    if isinstance(item, Snapshot):
                        self._checkpoints.write(item)
                        continue
                    if step is None:
                        self._skip(item)
                        continue
                    self._take(item, step)
                    self._kept.keep(item)  # for the evaluation
        except SideError as error:
            if not isinstance(error.__cause__, NotFoundError):
                record.failure = error
        except KeyboardInterrupt:  # a step did not end: what was done before it is saved
            if not self._stopped:
                raise
            self._checkpoints.end()
        record.loop_s = time.perf_counter() - self._loop_started
        if lost := dropped_frames(self._dataset):
            record.plan["dropped"] = lost
        for line in messages.of_speed(lost, record.reports):
            self._display.warn(line)
        nothing = messages.nothing_done(self._dataset.name, record, self._slam.localiser)
        if nothing is not None and record.failure is None:
            raise KeyboardInterrupt if self._stopped else nothing

    def refine(self) -> None:
        """Fit the finished map some iterations more; Ctrl-C alone ends that early, and the run goes on.

        Not after an interrupted or failed run. A failure is kept in the record.
        """
        asked, record = self.config.refine, self.record
        if record.refine_iterations < asked and self._slam.can_refine and not self._ended:
            self._display.stage("refining", asked - record.refine_iterations)
            started = time.perf_counter() - record.refine_s
            while record.refine_iterations < asked and not self._stopped:
                try:
                    with self._interruption.breakable():
                        self._slam.refine()
                except KeyboardInterrupt:
                    self._checkpoints.end()
                    break
                except Exception as error:
                    record.failure = SideError("refinement", f"at iteration {record.refine_iterations}")
                    record.failure.__cause__ = error
                    break
                record.refine_iterations += 1
                record.refine_s = time.perf_counter() - started
                self._display.advance()
                if self._checkpoints.due():
                    self._checkpoints.write_now()
            if self._interruption.number == signal.SIGINT:
                self._interruption.forget()
                self._display.note(f"refinement ended after {record.refine_iterations} of {asked} iterations")
        if record.failure is not None:  # said first: what follows may fail for the same reason
            self._saver.failed(str(record.failure), record.failure.__cause__ or record.failure)
        self._checkpoints.write_now()
        if not self._ended:
            self._saver.judge(self.config.slam.gicp.far if self._dataset.has_depth else None)
            self._saver.attempt("fitting what was out of memory", self._slam.finish)
        record.counts = dict(self._slam.counts)
        record.correct(self._slam.fitted_poses(), self._slam.keyframe_indices)

    def save(self) -> None:
        """Write all but what comes of comparing pictures; a part that fails is said, the rest is written."""
        self._display.stage("saving")
        self._saver.save(self._slam)

    def evaluate(self) -> None:
        """Compare the map with the frames, and add that to what is saved.

        Not after an interrupted or failed run. A failure is said and kept in the record.
        """
        if self._stopped or (self._ended and not self._saver.moved):
            return
        self._display.stage("evaluating", len(self.record.reports))
        with contextlib.suppress(KeyboardInterrupt), self._interruption.breakable():
            self._saver.attempt("evaluation", self._compare)
        self._display.stage("saving")
        self._saver.save_tables()

    def show(self) -> int:
        """Say how the run ended, with its figures where it is complete; return the exit code."""
        display, record, where = self._display, self.record, self._saver.where
        display.close()
        share = f"{len(record.reports)}{'' if is_live(self._dataset) else f' of {len(self._indices)}'} frames"
        if record.failure is not None:
            display.conclude(f"failed after {share}; saved in {where}")
            return FAILED
        if self._stopped:
            display.conclude(f"interrupted after {share}; saved in {where}")
            return self._interruption.exit_code
        display.results(self._saver.metrics, measured(self._saver.metrics))
        self._saver.warn_of_truth()
        display.conclude(self._saver.outcome)
        return FAILED if record.failures else DONE

    def _begin(self, folder: Path) -> None:
        """Write what a run folder has from the start."""
        write_toml(dataclasses.replace(self.config, out=None), folder / "config.toml")
        write_camera(folder / "camera.json", self._reader.camera)

    def _compare(self) -> None:
        record = self.record
        views = ViewSaver(self._saver, self.config.save_renders, self._slam.map_parts)

        def on_view(frame: Frame, view: Rendered, score: FrameScore) -> None:
            self._display.advance()
            views.save(frame, view, score.psnr)

        evaluation = compare(
            itertools.takewhile(lambda _: not self._stopped, self._kept.again(record.poses())),
            record.poses(),
            self._slam.render,
            mapped=self._slam.keyframe_indices,
            watched=self._slam.voting_indices,
            lpips=open_lpips(self.config.device),
            on_view=on_view,
        )
        views.finish()
        if not self._stopped:
            record.evaluation = evaluation

    @property
    def _stopped(self) -> bool:
        return self._interruption.requested

    @property
    def _ended(self) -> bool:
        return self._stopped or bool(self.record.failures) or self.record.failure is not None

    def _take(self, frame: Frame, step: StepReport) -> None:
        """Add a processed frame to the record, and show it."""
        (reports := self.record.reports).append(step)
        if frame.T_wc is not None:
            self.record.truth[frame.index] = frame.T_wc
        if step.verdict is Verdict.LOST:
            self._display.warn(f"frame {frame.index} lost: {step.reason}")
        for line in messages.of_places(step, self._slam.localiser):
            self._display.note(line)
        self.record.loop_s = time.perf_counter() - self._loop_started
        self._display.advance(messages.status(step, len(reports) / self.record.loop_s))
        self._loop_started += self._viewer.show(frame, step, lambda: self._stopped)

    def _skip(self, frame: BadFrame) -> None:
        self.record.skipped[frame.index] = frame.reason
        self._display.advance(f"frame {frame.index} skipped")
        self._display.warn(f"frame {frame.index} skipped: {frame.reason}")
