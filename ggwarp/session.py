# SPDX-License-Identifier: Apache-2.0
"""A run from the first frame to the saved results, with everything built."""

from __future__ import annotations

import dataclasses
import itertools
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from ggwarp.console import Display
from ggwarp.datasets import BadFrame, FrameReader
from ggwarp.evaluation.evaluate import FrameScore
from ggwarp.evaluation.evaluate import evaluate as compare
from ggwarp.evaluation.image import open_lpips
from ggwarp.pipeline.runner import SideError, run_steps
from ggwarp.pipeline.slam import Slam
from ggwarp.results import run_folder
from ggwarp.results.metrics import metrics_of
from ggwarp.results.record import RunRecord
from ggwarp.results.renders import RenderWriter
from ggwarp.runtime import loading
from ggwarp.types import Frame, Rendered, StepReport, Verdict

_KEPT_BYTES = 1 << 29  # frames held for the evaluation instead of being read again
_FRAME_BYTES = 3 + 4 + 4 + 4  # a pixel's colour, depth, mask and true mask


class Interruption:
    """Turns the first Ctrl-C into a request to stop after the current step; a second one kills."""

    requested = False

    def __enter__(self) -> Interruption:
        try:
            self._previous = signal.signal(signal.SIGINT, self._request)
        except ValueError:  # not the main thread: signals are the caller's business
            self._previous = None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


def load_kernels(device: str, display: Display) -> None:
    """Load every kernel imported so far, and say so when they must be compiled first."""
    modules = loading.imported_kernel_modules(device)
    cold = loading.uncompiled(modules, device)
    display.stage(f"compiling kernels (first run only): {len(cold)} modules" if cold else "loading kernels")
    loading.load(modules, device)


def track_and_map(
    slam: Slam,
    reader: FrameReader,
    record: RunRecord,
    display: Display,
    interruption: Interruption,
    *,
    concurrent: bool = False,
) -> list[Frame]:
    """Process the frames into ``record``; a failure of either side ends the loop and is kept there.

    Args:
        concurrent: track in a second thread, beside the mapper.

    Returns:
        The frames, for the evaluation; none when they are too many to hold in memory.
    """
    size = len(reader) * reader.camera.width * reader.camera.height * _FRAME_BYTES
    kept: list[Frame] = []
    display.stage("frames", len(reader))
    started = time.perf_counter()
    try:
        for item, step in run_steps(
            slam, reader, concurrent=concurrent, stopped=lambda: interruption.requested
        ):
            if step is None:
                _skip(item, record, display)
                continue
            record.reports.append(step)
            if item.T_wc is not None:
                record.truth[item.index] = item.T_wc
            if size <= _KEPT_BYTES:
                kept.append(dataclasses.replace(item, sensor_depth=None))
            if step.verdict is Verdict.LOST:
                display.warn(f"frame {item.index} lost: {step.reason}")
            display.advance(_status(step, len(record.reports) / (time.perf_counter() - started)))
    except SideError as error:
        record.failure = error
    record.loop_s = time.perf_counter() - started
    record.counts = dict(slam.counts)
    late = [r for r in record.reports if r.late_ms > 0.0]
    if late:
        behind = max(r.frames_behind for r in late)
        display.warn(
            f"{len(late)} of {len(record.reports)} frames were taken up late, by up to "
            f"{max(r.late_ms for r in late):.0f} ms"
            + (f", with up to {behind} newer ones waiting" if behind else "")
        )
    return kept


def _skip(frame: BadFrame, record: RunRecord, display: Display) -> None:
    record.skipped[frame.index] = frame.reason
    display.advance(f"frame {frame.index} skipped")
    display.warn(f"frame {frame.index} skipped: {frame.reason}")


def _status(step: StepReport, fps: float) -> str:
    late = f", {step.late_ms:.0f} ms late" if step.late_ms else ""
    return (
        f"{fps:.1f} fps{late}, tracking {step.tracking_ms:.0f} ms, mapping {step.mapping_ms:.0f} ms, "
        f"{step.gaussians / 1000:.1f}k Gaussians"
    )


def refine(
    slam: Slam, iterations: int, record: RunRecord, display: Display, interruption: Interruption
) -> None:
    """Fit the finished map ``iterations`` times more; Ctrl-C ends that early and the run goes on.

    Not after an interrupted or failed run. A failure is kept in ``record``.
    """
    if not iterations or not slam.can_refine or interruption.requested or record.failure is not None:
        return
    display.stage("refining", iterations)
    started = time.perf_counter()
    while record.refine_iterations < iterations and not interruption.requested:
        try:
            slam.refine()
        except Exception as error:
            record.failure = SideError("refinement", f"at iteration {record.refine_iterations}")
            record.failure.__cause__ = error
            break
        record.refine_iterations += 1
        display.advance()
    record.refine_s = time.perf_counter() - started
    if interruption.requested:
        interruption.requested = False
        display.note(f"refinement ended after {record.refine_iterations} of {iterations} iterations")


def _frames(reader: FrameReader) -> Iterator[Frame]:
    with reader:
        yield from (f for f in reader if isinstance(f, Frame))


def evaluate(
    slam: Slam,
    reader: FrameReader,
    kept: list[Frame],
    record: RunRecord,
    folder: Path,
    display: Display,
    interruption: Interruption,
    *,
    every: int,
) -> None:
    """Compare the map with the frames and save renders; an interrupted or failed run is not compared.

    Args:
        kept: the frames; empty: they are read again by ``reader``.
        folder: the run folder.
        every: save the renders of every so many frames; 0: of none.
    """
    if interruption.requested or record.failure is not None:
        return
    saved = {r.index for r in record.reports[::every]} if every else set()
    writer = RenderWriter(folder / "renders", slam.map_arrays().identities)
    display.stage("evaluating", len(record.reports))

    def on_view(frame: Frame, view: Rendered, score: FrameScore) -> None:
        display.advance()
        if frame.index in saved:
            writer.write(frame.index, view)

    evaluation = compare(
        itertools.takewhile(lambda _: not interruption.requested, kept or _frames(reader)),
        record.poses(),
        slam.render,
        mapped=slam.keyframe_indices,
        watched=slam.voting_indices,
        lpips=open_lpips(),
        on_view=on_view,
    )
    if not interruption.requested:
        record.evaluation = evaluation


def save(slam: Slam, record: RunRecord, folder: Path, started: float) -> dict[str, Any]:
    """Write the run folder and return what ``metrics.json`` holds."""
    run_folder.write_trajectories(folder, record)  # first: where the device has failed, the map cannot be had
    arrays = slam.map_arrays()
    run_folder.write_map(folder, arrays, slam.objects(record.class_names), slam.linear_classifier())
    run_folder.write_frames(folder, record)
    run_folder.write_object_scores(folder, record)
    metrics = metrics_of(record, wall_s=time.perf_counter() - started, gaussians=len(arrays))
    run_folder.write_metrics(folder, metrics)
    return metrics
