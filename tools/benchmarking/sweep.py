# SPDX-License-Identifier: Apache-2.0
"""``sweep``: sequences by frame-rate caps, in the rows of GG-SLAM's tables 1 and 3."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarking.options import Common, is_cpu, new_record
from benchmarking.record import Record, Row, Section
from benchmarking.runs import SYNCHRONOUS, Outcome, RunSpec, accepts, execute
from benchmarking.system import sections
from ggwarp.config import device_name

REPLICA = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
CAPS, CPU_CAPS = ("30", "20", "10", "uncapped"), ("10", "5", "2", "uncapped")
TABLE = "by sequence and cap"

_METRICS = {"PSNR": ("psnr", 2), "SSIM": ("ssim", 3), "LPIPS": ("lpips", 3), "FPS": ("fps", 2)}
"""Row of the paper's tables -> key in metrics.json and digits."""


@dataclass(frozen=True)
class SweepOptions(Common):
    """Every sequence at every frame-rate cap: PSNR, SSIM, LPIPS and FPS, a row each, with the average."""

    seq: tuple[str, ...] | None = None
    """Sequences; default: Replica's eight, on a CPU office0 and, if the data root has it, redkitchen."""
    fps: tuple[str, ...] | None = None
    """Caps; none: synchronous. A cap that the command does not know is left out, and said. Default: the
    paper's 30, 20, 10, uncapped; on a CPU, which such rates leave no time to map, 10, 5, 2, uncapped."""
    preset: str = "gg-slam"
    """Preset of all runs."""
    frames: str | None = None
    """Slice of each sequence, A:B or A:B:STEP; default: all frames, the first 60 on a CPU."""
    scale: float | None = None
    """Image scale; default: the command's."""
    data: Path | None = None
    """Data root; default: $GGWARP_DATA, else ./data."""


def run(options: SweepOptions) -> Record:
    """Run everything and return the record; a run that fails is noted."""
    record = new_record("sweep", options)
    device = device_name(options.device)
    sequences, frames, wanted = defaults(options, on_cpu=is_cpu(record))
    record.settings |= {"seq": list(sequences), "frames": frames, "fps": list(wanted)}
    outcomes: dict[RunSpec, Outcome] = {}
    caps = [cap for cap in wanted if accepts(cap)]
    record.notes += [f"--fps {cap}: the command does not take it" for cap in wanted if cap not in caps]
    for cap in caps:
        for seq in sequences:
            spec = RunSpec(seq, options.preset, cap, frames, options.scale, options.data, device)
            outcome = execute(spec)
            outcomes[spec] = outcome
            if outcome.failure:
                record.notes.append(outcome.failure)
    rows = [row for cap in caps for row in paper_rows(options.preset, cap, _of_cap(outcomes, cap))]
    record.sections.append(
        Section(TABLE, rows, "all frames, as in the paper; average over what was measured")
    )
    done = {spec: outcome for spec, outcome in outcomes.items() if not outcome.failure}
    record.sections += sections(done)
    return record


def defaults(options: SweepOptions, *, on_cpu: bool) -> tuple[tuple[str, ...], str | None, tuple[str, ...]]:
    """Return sequences, the slice of each, and caps: what ``options`` say, or what takes minutes."""
    frames = options.frames or ("0:20" if options.quick else "0:60" if on_cpu else None)
    caps = options.fps or (CPU_CAPS if on_cpu else CAPS)
    if options.seq is not None:
        return options.seq, frames, caps
    if not on_cpu:
        return REPLICA, frames, caps
    root = options.data or Path(os.environ.get("GGWARP_DATA") or "data")
    return ("office0", *(["redkitchen"] if (root / "redkitchen").is_dir() else [])), frames, caps


def _of_cap(outcomes: dict[RunSpec, Outcome], cap: str) -> dict[str, dict[str, Any]]:
    """Return column -> metrics of the runs with that cap."""
    found = {}
    for spec, outcome in outcomes.items():
        if spec.fps == cap:
            built_in = outcome.metrics.get("dataset") == "synthetic" and spec.seq not in (
                "office",
                "synthetic",
            )
            found[f"{spec.seq} (built-in)" if built_in else spec.seq] = outcome.metrics
    return found


def paper_rows(preset: str, cap: str, metrics: dict[str, dict[str, Any]]) -> list[Row]:
    """Return the rows PSNR, SSIM, LPIPS and FPS of one cap.

    Args:
        metrics: sequence -> its ``metrics.json``; {}: it failed.

    Returns:
        Rows of text: system, metric, a column a sequence, Avg.; - where nothing was measured.
    """
    at = "synchronous" if cap == SYNCHRONOUS else cap if cap == "uncapped" else f"@{cap}"
    rows: list[Row] = []
    for name, (key, digits) in _METRICS.items():
        values = {seq: found.get(key) for seq, found in metrics.items()}
        known = [value for value in values.values() if value is not None]
        average = sum(known) / len(known) if known else None
        cells = {seq: _text(value, digits) for seq, value in values.items()}
        rows.append({"system": f"ggwarp {preset} {at}", "": name, **cells, "Avg.": _text(average, digits)})
    return rows


def _text(value: float | None, digits: int) -> str:
    """Return ``value`` as the paper prints it: 35.37, .941."""
    if value is None:
        return "-"
    text = f"{value:.{digits}f}"
    return text.removeprefix("0") if digits == 3 else text
