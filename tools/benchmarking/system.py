# SPDX-License-Identifier: Apache-2.0
"""``system``: whole runs: frames a second, where the time goes, memory and quality."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarking.options import Common, is_cpu, new_record, percent
from benchmarking.record import Check, Record, Row, Section
from benchmarking.runs import SYNCHRONOUS, Outcome, RunSpec, execute
from ggwarp.config import device_name

SPEED, STAGES, COURSE, QUALITY = "speed", "where the time goes", "as a run goes on", "quality"
_LATE_S, _LOSS_DB = 0.4, 0.5
_CAPPED_ITERATIONS = 20.0


@dataclass(frozen=True)
class SystemOptions(Common):
    """Runs of the whole system: every sequence by every preset by every cap."""

    seq: tuple[str, ...] = ("office0",)
    """Sequences."""
    preset: tuple[str, ...] = ("gg-slam",)
    """Presets."""
    fps: tuple[str, ...] = (SYNCHRONOUS,)
    """Frames a second at which frames arrive; none: synchronous, a fixed amount of mapping a frame."""
    frames: str | None = None
    """Slice of each sequence, A:B or A:B:STEP."""
    scale: float | None = None
    """Image scale; default: the command's."""
    data: Path | None = None
    """Data root; default: $GGWARP_DATA, else ./data."""


def run(options: SystemOptions) -> Record:
    """Run everything and return the record; a run that fails is noted."""
    record = new_record("system", options)
    frames = options.frames or ("0:20" if options.quick else None)
    outcomes: dict[RunSpec, Outcome] = {}
    for seq in options.seq:
        for preset in options.preset:
            for fps in options.fps:
                device = device_name(options.device)
                spec = RunSpec(seq, preset, fps, frames, options.scale, options.data, device)
                outcome = execute(spec)
                if outcome.failure:
                    record.notes.append(outcome.failure)
                else:
                    outcomes[spec] = outcome
    record.sections += sections(outcomes)
    record.checks += [c for s, o in outcomes.items() for c in checks(s, o, outcomes, is_cpu(record))]
    return record


def sections(outcomes: dict[RunSpec, Outcome]) -> list[Section]:
    """Return the tables of some runs: speed, stages, quality."""
    runs = list(outcomes.items())
    return [
        Section(
            SPEED,
            [speed_row(s, o) for s, o in runs],
            "FPS: frames over the time of the tracking and mapping loop, reading included",
        ),
        Section(
            STAGES,
            [stage_row(s, o) for s, o in runs],
            "shares of the loop's time; rest: reading, waiting for frames, deciding; what runs at once "
            "counts on both sides. Latency: from a frame's arrival to its pose; late: until it is taken up",
        ),
        Section(COURSE, [row for s, o in runs for row in course_rows(s, o)], "means of each quarter"),
        Section(QUALITY, [quality_row(s, o) for s, o in runs]),
    ]


def _named(spec: RunSpec, outcome: Outcome) -> Row:
    built_in = outcome.metrics.get("dataset") == "synthetic"
    return {
        "sequence": f"{spec.seq} (built-in)" if built_in else spec.seq,
        "preset": spec.preset,
        "cap": "-" if spec.fps == SYNCHRONOUS else spec.fps,
    }


def speed_row(spec: RunSpec, outcome: Outcome) -> Row:
    """Return a run's speed and memory."""
    frames, iterations = outcome.metric("frames"), outcome.metric("mapping_iterations")
    return {
        **_named(spec, outcome),
        "frames": frames,
        "FPS": outcome.metric("fps"),
        "iterations": iterations,
        "a frame": iterations / frames if frames and iterations is not None else None,
        "peak MB": outcome.metric("peak_memory_mb"),
        "wall s": outcome.metric("wall_s"),
    }


def stage_row(spec: RunSpec, outcome: Outcome) -> Row:
    """Return each stage's share of a run's time, and how late its frames were."""
    late = outcome.late_ms if spec.fps != SYNCHRONOUS else []
    return {
        **_named(spec, outcome),
        **{f"{name} %": None if s is None else percent(s) for name, s in outcome.shares.items()},
        "latency p50 ms": outcome.metric("latency_ms_p50"),
        "p95 ms": outcome.metric("latency_ms_p95"),
        "late max ms": max(late) if late else None,
    }


def course_rows(spec: RunSpec, outcome: Outcome) -> list[Row]:
    """Return how the cost of a frame and of an iteration changes from quarter to quarter of a run."""
    rows = []
    for part in np.array_split(np.arange(len(outcome.frames)), min(4, len(outcome.frames))):
        frames = [outcome.frames[k] for k in part]
        iterations = sum(f["mapping_iterations"] for f in frames)
        mapping = sum(f["mapping_ms"] for f in frames)
        rows.append(
            {
                **_named(spec, outcome),
                "frames": f"{frames[0]['index']:.0f}-{frames[-1]['index']:.0f}",
                "Gaussians": round(frames[-1]["gaussians"]),
                "tracking ms": sum(f["tracking_ms"] for f in frames) / len(frames),
                "mapping ms an iteration": mapping / iterations if iterations else None,
            }
        )
    return rows


def quality_row(spec: RunSpec, outcome: Outcome) -> Row:
    """Return a run's quality."""
    names = {"PSNR": "psnr", "held-out PSNR": "heldout_psnr", "SSIM": "ssim", "LPIPS": "lpips"}
    names |= {"depth L1 cm": "depth_l1_cm", "mIoU": "miou", "ATE RMSE cm": "ate_rmse_cm"}
    names |= {"lost": "frames_lost", "Gaussians": "gaussians"}
    return _named(spec, outcome) | {title: outcome.metric(key) for title, key in names.items()}


def checks(spec: RunSpec, outcome: Outcome, outcomes: dict[RunSpec, Outcome], on_cpu: bool) -> list[Check]:
    """Return the checks that there are targets for."""
    found = []
    psnr, ate = outcome.metric("psnr"), outcome.metric("ate_rmse_cm")
    said = ", ".join(f"{n} {v:.2f} {u}" for n, v, u in (("PSNR", psnr, "dB"), ("ATE", ate, "cm")) if v)
    fps, frames = outcome.metric("fps"), outcome.metric("frames")
    synchronous = spec.fps == SYNCHRONOUS
    if on_cpu and synchronous and spec.preset == "fast" and Path(spec.seq).name == "redkitchen":
        found.append(Check(f"FPS: {spec.label}", fps, ">=", 10.0, "", said))
    if not on_cpu and spec.fps == "uncapped" and outcome.metrics.get("dataset") == "synthetic":
        found.append(Check(f"FPS: {spec.label}", fps, ">=", 100.0, "", said))
    if not on_cpu and spec.fps == "30" and outcome.metrics.get("dataset") == "synthetic" and frames:
        value = outcome.metrics["mapping_iterations"] / frames
        found.append(Check(f"iterations a frame: {spec.label}", value, ">=", _CAPPED_ITERATIONS, "", said))
    if not synchronous and spec.fps != "uncapped":
        latest = max(outcome.late_ms, default=0.0) / 1e3
        found.append(Check(f"latest frame: {spec.label}", latest, "<=", _LATE_S, "s"))
        found += _loss(spec, psnr, outcomes)
    return found


def _loss(spec: RunSpec, psnr: float | None, outcomes: dict[RunSpec, Outcome]) -> list[Check]:
    """Return the check of a live run's PSNR beside the synchronous run's, where there is one."""
    for other, outcome in outcomes.items():
        if (other.seq, other.preset, other.fps) == (spec.seq, spec.preset, SYNCHRONOUS):
            reference = outcome.metric("psnr")
            value = None if psnr is None or reference is None else reference - psnr
            return [Check(f"PSNR lost to synchronous: {spec.label}", value, "<=", _LOSS_DB, "dB")]
    return []
