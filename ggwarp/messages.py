# SPDX-License-Identifier: Apache-2.0
"""What a session says on its way, as text."""

from __future__ import annotations

import contextlib
import re
import sys
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ggwarp.config import RunConfig
from ggwarp.console import Display
from ggwarp.datasets import BUILT_IN, Dataset, DatasetError
from ggwarp.datasets.base import is_live
from ggwarp.datasets.plan.sequence_plan import SequencePlan
from ggwarp.io.printable import printable
from ggwarp.pipeline.loops.localisation import Localiser, view_index
from ggwarp.results.record import RunRecord
from ggwarp.types import StepReport, Verdict

_FEW_READINGS = 0.02
"""Share of pixels with depth below which there are too few points to track."""
_NEAR = 0.1
"""Metres: nearer depth is not used by tracking."""
_UNIT = "is the depth's unit right?"


def introduce(display: Display, plan: SequencePlan, rest: Iterable[str]) -> None:
    """Say what a run's sequence is taken for, then ``rest``, then what is odd about it."""
    for line in (*plan.lines(), *rest):
        display.note(line)
    for line in plan.warnings:
        display.warn(line)


def introduction(asked: RunConfig, config: RunConfig, dataset: Dataset, frames: int) -> Iterator[str]:
    """Yield what a run begins with: its frames and their size, and what it must do without."""
    if dataset.kind == "synthetic" and config.seq not in BUILT_IN:
        yield (
            f"{config.seq} is not under {config.data_root()}: using the built-in synthetic office instead "
            f"(the real one: ggwarp download replica {config.seq})"
        )
    size, native = dataset.camera.scaled(config.scale or 1.0), dataset.camera
    yield (
        f"{'live' if is_live(dataset) else frames} frames on {config.device} at {size.width}x{size.height} "
        f"(--scale {config.scale:g} of {native.width}x{native.height})"
    )
    if config.slam.mono:
        yield ("no depth: tracking by colour alone, no scale, objects are not learnt")
    elif asked.slam.use_identity and not dataset.has_masks:
        yield ("no object masks (--masks DIR gives some): objects are not learnt")


def left_by_a_killed_run(left: Path, kept: str) -> str:
    """Return what became of the folder that a killed run left; ``kept``: where it is now, if anywhere."""
    if not kept:
        return f"removed {left}, which a run that was killed had left"
    return f"a run that was killed had left {left}: {kept}"


def status(step: StepReport, fps: float) -> str:
    """Return how the run stands after a frame."""
    late = f", {step.late_ms:.0f} ms late" if step.late_ms else ""
    return (
        f"{fps:.1f} fps{late}, tracking {step.tracking_ms:.0f} ms, mapping {step.mapping_ms:.0f} ms, "
        f"{step.gaussians / 1000:.1f}k Gaussians"
    )


def total_failure(reports: Sequence[StepReport], plan: Mapping[str, Any], far: float | None) -> str:
    """Return why a run that ended has tracked or mapped nothing, with the likely cause; empty: it has.

    Args:
        plan: how the sequence was read, as ``metrics.json`` has it.
        far: metres beyond which depth is not used; None: there is no depth.
    """
    lost = [r for r in reports if r.verdict is Verdict.LOST]
    empty = bool(reports) and reports[-1].gaussians == 0
    if not (empty or (len(reports) > 2 and len(lost) >= len(reports) - 1)):
        return ""
    what = "the map is empty" if empty else f"{len(lost)} of {len(reports)} frames were lost"
    median, valid = plan.get("median_depth_m"), plan.get("valid_depth")
    if far is not None and valid is not None and valid < _FEW_READINGS:
        cause = f"only {100.0 * valid:.2g} % of the pixels have a depth reading"
    elif far is not None and median is not None and median > far:
        cause = (
            f"the median depth is {median:.3g} m, and beyond --gicp.far {far:g} depth is not used: {_UNIT}"
        )
    elif far is not None and median is not None and median < _NEAR:
        cause = f"the median depth is {median:.3g} m, and nearer than {_NEAR:g} m it is not used: {_UNIT}"
    elif plan.get("warnings"):
        cause = str(plan["warnings"][0])
    else:
        reasons = Counter(re.sub(r"[\d.]+", "N", r.reason) for r in lost)
        common = next((reason for reason, _ in reasons.most_common(1)), "")
        cause = next((r.reason for r in lost if re.sub(r"[\d.]+", "N", r.reason) == common), "")
    return f"{what}; likely: {cause}" if cause else what


def of_places(step: StepReport, localiser: Localiser | None) -> Iterator[str]:
    """Yield where in an earlier map a frame was found, if it was this one, and which loop it closed."""
    place = None if localiser is None else localiser.place
    if localiser is not None and place is not None and place.frame == step.index:
        yield (
            f"frame {place.frame} found in {localiser.name}: near frame {place.near}, "
            f"{place.matches} matches, {100.0 * place.overlap:.0f} % of its points on the map"
        )
    if step.loop_with is not None:
        seen = step.loop_with
        where = f"frame {seen}" if seen >= 0 else f"frame {view_index(seen)} of the earlier run"
        yield (
            f"frame {step.index}: a loop, as at {where}; the map moved by up to "
            f"{step.loop_moved_cm:.1f} cm ({step.loop_ms:.0f} ms)"
        )


def nothing_done(name: str, record: RunRecord, localiser: Localiser | None) -> Exception | None:
    """Return why there is nothing to save of the frames of the sequence ``name``; None: there is."""
    if record.reports:
        return None if localiser is None else localiser.failure
    first = next(iter(record.skipped.values()), "none came")
    return DatasetError(f"{name}: no frame could be used; the first: {first}")


def of_speed(dropped: int, reports: Sequence[StepReport]) -> Iterator[str]:
    """Yield what came faster than it was processed."""
    if dropped:
        yield f"{dropped} pictures of the camera came too fast and were dropped"
    if late := lateness(reports):
        yield late


def lateness(reports: Sequence[StepReport]) -> str:
    """Return how late frames were taken up; empty where none was."""
    late = [r for r in reports if r.late_ms > 0.0]
    if not late:
        return ""
    behind = max(r.frames_behind for r in late)
    waiting = f", with up to {behind} newer ones waiting" if behind else ""
    worst = max(r.late_ms for r in late)
    return f"{len(late)} of {len(reports)} frames were taken up late, by up to {worst:.0f} ms{waiting}"


def say_error(line: str) -> None:
    """Print a line as an error, where there still is a terminal."""
    with contextlib.suppress(OSError):
        print(f"ggwarp: {printable(line)}", file=sys.stderr)


def explain(what: str, reason: BaseException, *, silent: bool = False) -> str:
    """Say that ``what`` failed, and why; where it looks like a fault of ours, say where in the code, too.

    Returns:
        The line that was said, or with ``silent`` is for the record alone.
    """
    if isinstance(reason, OSError) and reason.strerror:
        why = f"{reason.filename}: {reason.strerror}" if reason.filename else reason.strerror
    else:
        why = f"{type(reason).__name__}: {reason}" if str(reason) else type(reason).__name__
    line = printable(f"{what}: {why}")
    with contextlib.suppress(OSError):  # the terminal may have gone
        if silent:
            return line
        if not isinstance(reason, (DatasetError, OSError, MemoryError)):
            traceback.print_exception(reason)
        print(f"ggwarp: {line}", file=sys.stderr)
    return line
