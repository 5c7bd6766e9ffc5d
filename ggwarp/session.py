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
from ggwarp.kernels import loading
from ggwarp.pipeline import report
from ggwarp.pipeline.renders import RenderWriter
from ggwarp.pipeline.slam import Slam
from ggwarp.types import Frame, Rendered, StepReport, Verdict

_KEPT_BYTES = 1 << 29  # frames held for the evaluation instead of being read again
_FRAME_BYTES = 3 + 4 + 4  # a pixel's colour, depth and mask


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
    slam: Slam, reader: FrameReader, record: report.RunRecord, display: Display, interruption: Interruption
) -> list[Frame]:
    """Process the frames into ``record``.

    Returns:
        The frames, for the evaluation; none when they are too many to hold in memory.
    """
    size = len(reader) * reader.camera.width * reader.camera.height * _FRAME_BYTES
    kept: list[Frame] = []
    display.stage("frames", len(reader))
    started = time.perf_counter()
    for frame in reader:
        if isinstance(frame, BadFrame):
            record.skipped[frame.index] = frame.reason
            display.advance(f"frame {frame.index} skipped")
            display.warn(f"frame {frame.index} skipped: {frame.reason}")
        else:
            step = slam.step(frame)
            record.reports.append(step)
            if frame.T_wc is not None:
                record.truth[frame.index] = frame.T_wc
            if size <= _KEPT_BYTES:
                kept.append(dataclasses.replace(frame, sensor_depth=None))
            if step.verdict is Verdict.LOST:
                display.warn(f"frame {frame.index} lost: {step.reason}")
            display.advance(_status(step, len(record.reports) / (time.perf_counter() - started)))
        if interruption.requested:
            break
    record.loop_s = time.perf_counter() - started
    record.counts = dict(slam.counts)
    late = [r.late_ms for r in record.reports if r.late_ms > 0.0]
    if late:
        display.warn(
            f"{len(late)} of {len(record.reports)} frames were taken up late, by up to {max(late):.0f} ms"
        )
    return kept


def _status(step: StepReport, fps: float) -> str:
    return (
        f"{fps:.1f} fps, tracking {step.tracking_ms:.0f} ms, mapping {step.mapping_ms:.0f} ms, "
        f"{step.gaussians / 1000:.1f}k Gaussians"
    )


def _frames(reader: FrameReader) -> Iterator[Frame]:
    with reader:
        yield from (f for f in reader if isinstance(f, Frame))


def evaluate(
    slam: Slam,
    reader: FrameReader,
    kept: list[Frame],
    record: report.RunRecord,
    folder: Path,
    display: Display,
    interruption: Interruption,
    *,
    every: int,
) -> None:
    """Compare the map with the frames and save renders; an interrupted run is not compared.

    Args:
        kept: the frames; empty: they are read again by ``reader``.
        folder: the run folder.
        every: save the renders of every so many frames; 0: of none.
    """
    if interruption.requested:
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
        lpips=open_lpips(),
        on_view=on_view,
    )
    if not interruption.requested:
        record.evaluation = evaluation


def save(slam: Slam, record: report.RunRecord, folder: Path, started: float) -> dict[str, Any]:
    """Write the run folder and return what ``metrics.json`` holds."""
    arrays = slam.map_arrays()
    report.write_trajectories(folder, record)
    report.write_map(folder, arrays, record.class_names)
    report.write_frames(folder, record)
    metrics = report.metrics_of(record, wall_s=time.perf_counter() - started, gaussians=len(arrays))
    report.write_metrics(folder, metrics)
    return metrics
