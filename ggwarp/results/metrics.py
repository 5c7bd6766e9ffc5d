# SPDX-License-Identifier: Apache-2.0
"""A run's figures, as ``metrics.json`` holds them."""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import ggwarp
from ggwarp.evaluation.conventions import doubt_of_truth
from ggwarp.evaluation.evaluate import Scores
from ggwarp.evaluation.trajectory import TrajectoryError, absolute_error, relative_error, to_scale
from ggwarp.results.record import RunRecord
from ggwarp.types import Float64, Verdict

RESULTS = {
    "trajectory": [
        "frames",
        "frames_lost",
        "frames_skipped",
        "alignment",
        "ate_rmse_cm",
        "ate_tracked_rmse_cm",
        "ate_live_rmse_cm",
        "ate_mean_cm",
        "rpe_rmse_cm",
        "position_std_cm",
        "depth_noise_mm",
        "loops_closed",
    ],
    "picture, all frames": ["psnr", "psnr_exposed", "ssim", "lpips", "depth_l1_cm"],
    "picture, held-out frames": [
        "heldout_psnr",
        "heldout_psnr_exposed",
        "heldout_ssim",
        "heldout_lpips",
        "heldout_depth_l1_cm",
    ],
    "objects": [
        "miou",
        "heldout_miou",
        "miou_matched",
        "miou_interior",
        "pq",
        "objects_true",
        "objects_found",
        "miou_against",
    ],
    "map": [
        "gaussians",
        "tracking_keyframes",
        "mapping_keyframes",
        "pictures_left_out",
        "pixels_left_out",
        "mapping_iterations",
        "refine_iterations",
    ],
    "pace": [
        "fps",
        "tracking_ms",
        "loop_ms",
        "latency_ms_p50",
        "latency_ms_p95",
        "frames_late",
        "late_ms_max",
        "frames_behind_max",
        "mapping_ms",
        "iterations_per_frame",
    ],
    "time and memory": ["refine_s", "wall_s", "peak_memory_mb"],
}
"""The figures by what they are about, and in which order they are shown."""

HEADLINE = ("ate_rmse_cm", "psnr", "fps", "frames_lost", "objects_found")
"""What is asked first."""

_IMAGE_FIGURES = (
    *("psnr", "psnr_exposed", "ssim", "lpips", "depth_l1_cm"),
    *("miou", "miou_matched", "miou_interior", "pixel_accuracy"),
)
_OBJECT_FIGURES = ("pq", "sq", "rq", "objects_true", "objects_found")  # of all frames alone


def metrics_of(record: RunRecord, *, wall_s: float, gaussians: int | None) -> dict[str, Any]:
    """Return the run's figures under their names in ``metrics.json``; None = not measured.

    ``ate_live_rmse_cm`` is of the poses as they were reported, the other trajectory figures are of those
    finally estimated: of all frames, lost ones at their interpolated or predicted poses, but for
    ``ate_tracked_rmse_cm``, which is of the others where some are lost. ``fps`` is frames over the time of
    the tracking and mapping loop, refinement not counted; ``tracking_ms``, ``loop_ms`` (of it) and
    ``mapping_ms`` are means per frame; ``wall_s`` runs from the command's start; ``depth_noise_mm`` is the
    standard deviation of depth that the frames show, at the depth of half of them; ``position_std_cm`` is the
    largest standard deviation of a position, from the first frame on, as the run itself knows it;
    ``failures`` has a line for each part of the run that failed, ``warnings`` those that the user was shown.
    """
    reports = record.reports
    ate, rpe, scale = _trajectory_errors(record)
    return {
        "sequence": record.sequence,
        "dataset": record.dataset,
        "device": record.device,
        "frames": len(reports),
        "fps": len(reports) / record.loop_s if reports and record.loop_s > 0.0 else None,
        "wall_s": wall_s,
        "tracking_ms": _mean(r.tracking_ms for r in reports),
        "loop_ms": _mean(r.loop_ms for r in reports),
        "mapping_ms": _mean(r.mapping_ms for r in reports),
        "mapping_iterations": sum(r.mapping_iterations for r in reports),
        "iterations_per_frame": _mean(r.mapping_iterations for r in reports),
        "refine_iterations": record.refine_iterations,
        "refine_s": record.refine_s,
        "latency_ms_p50": _percentile([r.latency_ms for r in reports], 50),
        "latency_ms_p95": _percentile([r.latency_ms for r in reports], 95),
        "frames_late": sum(r.late_ms > 0.0 for r in reports),
        "late_ms_max": max((r.late_ms for r in reports), default=None),
        "frames_behind_max": max((r.frames_behind for r in reports), default=None),
        "ate_rmse_cm": None if ate is None else 100.0 * ate.rmse,
        "ate_mean_cm": None if ate is None else 100.0 * ate.mean,
        "ate_tracked_rmse_cm": None if ate is None else _tracked_error_cm(record),
        "ate_live_rmse_cm": None
        if ate is None
        else _error_cm(record, {r.index: record.live.get(r.index, r.T_wc) for r in reports}),
        "rpe_rmse_cm": None if rpe is None else 100.0 * rpe.rmse,
        "position_std_cm": max((r.position_std_cm for r in reports if r.position_std_cm > 0.0), default=None),
        "depth_noise_mm": _percentile([r.depth_noise_mm for r in reports if r.depth_noise_mm > 0.0], 50),
        "alignment": None if ate is None else "sim3" if record.monocular else "se3",
        "scale": scale if record.monocular else None,
        "truth_doubt": _truth_doubt(record) or None,
        **_figures(record.evaluation.all_frames, (*_IMAGE_FIGURES, *_OBJECT_FIGURES)),
        **_figures(record.evaluation.held_out, _IMAGE_FIGURES, "heldout_"),
        "miou_against": record.evaluation.miou_against,
        "heldout_frames": record.evaluation.held_out.frames if record.evaluation.per_frame else None,
        "gaussians": gaussians,
        "tracking_keyframes": record.counts.get("tracking_keyframes", 0),
        "mapping_keyframes": record.counts.get("mapping_keyframes", 0),
        "pictures_left_out": record.counts.get("pictures_left_out", 0),
        "pixels_left_out": _share(record.counts, "pixels_left_out", "keyframe_pixels"),
        "frames_lost": record.counts.get("frames_lost", 0),
        "loops_closed": record.counts.get("loops_closed", 0),
        "frames_skipped": len(record.skipped),
        "peak_memory_mb": peak_memory_mb(),
        "interrupted": record.interrupted,
        "failures": list(record.failures),
        "warnings": list(record.warnings),
        "versions": versions(),
        "plan": record.plan or None,
    }


def measured(metrics: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return what the closing table shows: of :data:`RESULTS` what was measured, the headline last."""
    groups = {
        title: [key for key in keys if metrics.get(key) is not None and key not in HEADLINE]
        for title, keys in RESULTS.items()
    }
    groups["headline"] = [key for key in HEADLINE if metrics.get(key) is not None]
    return {title: keys for title, keys in groups.items() if keys}


def versions() -> dict[str, str]:
    """Return the versions of what computes, and the machine's kind."""
    found = {"ggwarp": ggwarp.__version__, "Python": platform.python_version()}
    for package in ("warp-lang", "numpy", "torch", "opencv-python-headless"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found | {"system": f"{platform.system()} {platform.machine()}"}


def peak_memory_mb() -> float | None:
    """Return the most memory this process has held, MiB; None where the system does not say."""
    try:
        import resource
        import sys
    except ImportError:
        return None
    with contextlib.suppress(OSError, StopIteration):
        # Linux' rusage of a process begins with what its parent held.
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) / 1024.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def _figures(scores: Scores, names: tuple[str, ...], prefix: str = "") -> dict[str, float | int | None]:
    return {prefix + name: getattr(scores, name) for name in names}


def _trajectory_errors(
    record: RunRecord,
) -> tuple[TrajectoryError | None, TrajectoryError | None, float | None]:
    """Return the absolute and the relative error, and the scale that was given to the estimate."""
    known = [r for r in record.reports if r.index in record.truth]
    tracked = sum(r.verdict is not Verdict.LOST for r in record.reports)
    # One pose held still fits any other: that would not be a measurement.
    if not known or tracked < min(2, len(record.reports)):
        return None, None, None
    estimated = np.stack([r.T_wc for r in known])
    true = np.stack([record.truth[r.index] for r in known])
    scale = 1.0
    if record.monocular:
        estimated, scale = to_scale(estimated, true)
    return absolute_error(estimated, true), relative_error(estimated, true), scale


def _truth_doubt(record: RunRecord) -> str:
    """Return which convention explains why truth and estimate disagree; empty: none, or they agree."""
    known = [r for r in record.reports if r.index in record.truth and r.verdict is not Verdict.LOST]
    if not known:
        return ""
    estimated = np.stack([r.T_wc for r in known])
    true = np.stack([record.truth[r.index] for r in known])
    return doubt_of_truth(to_scale(estimated, true)[0] if record.monocular else estimated, true)


def _tracked_error_cm(record: RunRecord) -> float | None:
    """Return the ATE RMSE of the frames that were not lost, cm; None where that is all, or says nothing."""
    tracked = {r.index: r.T_wc for r in record.reports if r.verdict is not Verdict.LOST}
    known = sum(index in record.truth for index in tracked)
    return _error_cm(record, tracked) if 2 <= known and len(tracked) < len(record.reports) else None


def _error_cm(record: RunRecord, poses: Mapping[int, Float64]) -> float:
    """Return the ATE RMSE of ``poses``, by frame, where truth is known, cm."""
    known = [index for index in poses if index in record.truth]
    estimated = np.stack([poses[index] for index in known])
    true = np.stack([record.truth[index] for index in known])
    return 100.0 * absolute_error(estimated, true, with_scale=record.monocular).rmse


def ate_per_frame(record: RunRecord) -> dict[int, float]:
    """Return index -> distance from the true position after alignment, cm; empty where that says nothing."""
    ate, _, _ = _trajectory_errors(record)
    known = [r.index for r in record.reports if r.index in record.truth]
    return {} if ate is None else dict(zip(known, (100.0 * ate.per_frame).tolist(), strict=True))


def _share(counts: Mapping[str, int], part: str, whole: str) -> float | None:
    return counts[part] / counts[whole] if counts.get(whole) else None


def _mean(values: Iterable[float]) -> float | None:
    listed = list(values)
    return float(np.mean(listed)) if listed else None


def _percentile(values: list[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None
