# SPDX-License-Identifier: Apache-2.0
"""The run folder: what a run leaves, file by file.

``trajectory.txt``, ``trajectory_gt.txt``, ``map.ply``, ``objects.json``, ``classifier.npz``,
``metrics.json``, ``frames.csv``, ``object_scores.csv`` and ``renders/``; the command adds ``config.toml`` and
``camera.json``.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.evaluation.evaluate import Evaluation, Scores
from ggwarp.evaluation.trajectory import TrajectoryError, absolute_error, relative_error, to_scale
from ggwarp.io.json import write_json
from ggwarp.io.ply import PlyGaussians, write_ply
from ggwarp.io.table import write_table
from ggwarp.io.trajectory import write_tum
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.objects.linear_classifier import LinearClassifier, write_classifier
from ggwarp.types import Float64, StepReport, Verdict

OUTPUTS = (
    "config.toml",
    "camera.json",
    "trajectory.txt",
    "trajectory_gt.txt",
    "map.ply",
    "objects.json",
    "classifier.npz",
    "metrics.json",
    "frames.csv",
    "object_scores.csv",
)
"""The files of a run folder, renders aside."""

FRAME_COLUMNS: tuple[str, ...] = (
    "index",
    "timestamp",
    "verdict",
    "reason",
    "overlap",
    "rmse_mm",
    "keyframe",
    "tracking_ms",
    "mapping_ms",
    "mapping_iterations",
    "latency_ms",
    "late_ms",
    "frames_behind",
    "gaussians",
    "loss",
    "ate_cm",
    "held_out",
    "psnr",
    "psnr_exposed",
    "ssim",
    "lpips",
    "depth_l1_cm",
)
"""Columns of ``frames.csv``; empty = not measured."""


_IMAGE_FIGURES = (
    *("psnr", "psnr_exposed", "ssim", "lpips", "depth_l1_cm"),
    *("miou", "miou_matched", "miou_interior", "pixel_accuracy"),
)
_OBJECT_FIGURES = ("pq", "sq", "rq", "objects_true", "objects_found")  # of all frames alone

OBJECT_COLUMNS: tuple[str, ...] = (
    "id",
    "name",
    "pixels",
    "rendered_pixels",
    "iou",
    "iou_interior",
    "matched_id",
    "iou_matched",
)
"""Columns of ``object_scores.csv``, see :class:`ggwarp.evaluation.objects.ObjectRow`."""


@dataclass
class RunRecord:
    """What a run gathers on its way, the map itself aside.

    Attributes:
        sequence: its name. dataset: its kind. device: "cpu" or "cuda:N".
        reports: one a processed frame, in order.
        truth: index -> [4, 4] true camera-to-world pose, where known.
        monocular: whether the trajectory has no scale of its own.
        skipped: index -> why the frame could not be used.
        counts: tracking_keyframes, mapping_keyframes, frames_lost.
        class_names: mask id -> what the object is, where the data says.
        loop_s: seconds from the first frame's arrival to the last one's end.
        refine_iterations, refine_s: spent on the map after the last frame.
        failure: what ended the run early; None: nothing did.
        evaluation: pictures and objects against the frames; empty when not done.
    """

    sequence: str
    dataset: str
    device: str
    reports: list[StepReport] = field(default_factory=list)
    truth: dict[int, Float64] = field(default_factory=dict)
    skipped: dict[int, str] = field(default_factory=dict)
    monocular: bool = False
    counts: dict[str, int] = field(default_factory=dict)
    class_names: dict[int, str] = field(default_factory=dict)
    loop_s: float = 0.0
    refine_iterations: int = 0
    refine_s: float = 0.0
    failure: Exception | None = None
    evaluation: Evaluation = field(default_factory=Evaluation)

    def poses(self) -> dict[int, Float64]:
        """Return index -> [4, 4] estimated camera-to-world pose."""
        return {r.index: r.T_wc for r in self.reports}

    def correct(self, poses: dict[int, Float64]) -> None:
        """Replace the poses of the frames in ``poses``: fitted after they were reported."""
        self.reports = [replace(r, T_wc=poses.get(r.index, r.T_wc)) for r in self.reports]


def create_run_folder(out: Path | None, sequence: str) -> Path:
    """Make the folder of a run and return it; an earlier run's files in it are removed.

    Args:
        out: the folder; None: ``runs/<sequence>/<UTC time>``, with a link ``runs/latest``.

    Raises:
        OSError: it cannot be made or written to.
    """
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        _remove_outputs(out)
        return out
    stamp = time.strftime("%Y-%m-%dT%H-%M-%SZ", time.gmtime())
    parent = Path("runs") / (re.sub(r"[^\w.-]+", "_", sequence) or "sequence")
    parent.mkdir(parents=True, exist_ok=True)
    folder, again = parent / stamp, 1
    while True:
        try:
            folder.mkdir()
            break
        except FileExistsError:
            again += 1
            folder = parent / f"{stamp}-{again}"
    _link_latest(folder)
    return folder


def write_trajectories(folder: Path, record: RunRecord) -> None:
    """Write ``trajectory.txt`` and, where any true pose is known, ``trajectory_gt.txt``."""
    reports = record.reports
    write_tum(folder / "trajectory.txt", [r.timestamp for r in reports], [r.T_wc for r in reports])
    known = [r for r in reports if r.index in record.truth]
    if known:
        poses = [record.truth[r.index] for r in known]
        write_tum(folder / "trajectory_gt.txt", [r.timestamp for r in known], poses)


def write_map(
    folder: Path, gaussians: PlyGaussians, objects: list[ObjectRecord], classifier: LinearClassifier | None
) -> None:
    """Write ``map.ply``, ``objects.json`` and, where there are identities, ``classifier.npz``."""
    write_ply(folder / "map.ply", **vars(gaussians))
    write_json(folder / "objects.json", {"objects": [record.to_json() for record in objects]})
    if classifier is not None:
        write_classifier(folder / "classifier.npz", classifier)


def write_frames(folder: Path, record: RunRecord) -> None:
    """Write ``frames.csv``: a row for every frame of the run, skipped ones included."""
    scores = {s.index: s for s in record.evaluation.per_frame}
    errors = _ate_per_frame(record)
    rows: dict[int, dict[str, Any]] = {
        index: {"index": index, "verdict": "skipped", "reason": reason}
        for index, reason in record.skipped.items()
    }
    for r in record.reports:
        row: dict[str, Any] = {name: getattr(r, name) for name in FRAME_COLUMNS if hasattr(r, name)}
        row |= {"verdict": r.verdict.value, "rmse_mm": 1e3 * r.rmse}
        row["ate_cm"] = errors.get(r.index)
        score = scores.get(r.index)
        if score is not None:
            row |= {name: getattr(score, name) for name in FRAME_COLUMNS if hasattr(score, name)}
            row["held_out"] = int(score.held_out)
        rows[r.index] = row
    write_table(folder / "frames.csv", FRAME_COLUMNS, [rows[index] for index in sorted(rows)])


def write_object_scores(folder: Path, record: RunRecord) -> None:
    """Write ``object_scores.csv``: a row for every true object, none where objects were not compared."""
    rows = [vars(r) | {"name": record.class_names.get(r.id)} for r in record.evaluation.objects]
    write_table(folder / "object_scores.csv", OBJECT_COLUMNS, rows)


def write_metrics(folder: Path, metrics: Mapping[str, Any]) -> None:
    """Write ``metrics.json``; what was not measured is null."""
    write_json(folder / "metrics.json", metrics)


def metrics_of(record: RunRecord, *, wall_s: float, gaussians: int) -> dict[str, Any]:
    """Return the run's figures under their names in ``metrics.json``; None = not measured.

    ``fps`` is frames over the time of the tracking and mapping loop, refinement not counted; ``tracking_ms``
    and ``mapping_ms`` are means per frame; ``wall_s`` runs from the command's start.
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
        "rpe_rmse_cm": None if rpe is None else 100.0 * rpe.rmse,
        "alignment": None if ate is None else "sim3" if record.monocular else "se3",
        "scale": scale if record.monocular else None,
        **_figures(record.evaluation.all_frames, (*_IMAGE_FIGURES, *_OBJECT_FIGURES)),
        **_figures(record.evaluation.held_out, _IMAGE_FIGURES, "heldout_"),
        "miou_against": record.evaluation.miou_against,
        "heldout_frames": record.evaluation.held_out.frames if record.evaluation.per_frame else None,
        "gaussians": gaussians,
        "tracking_keyframes": record.counts.get("tracking_keyframes", 0),
        "mapping_keyframes": record.counts.get("mapping_keyframes", 0),
        "frames_lost": record.counts.get("frames_lost", 0),
        "frames_skipped": len(record.skipped),
        "peak_memory_mb": peak_memory_mb(),
    }


def peak_memory_mb() -> float | None:
    """Return the most memory this process has held, MiB; None where the system does not say."""
    try:
        import resource
        import sys
    except ImportError:
        return None
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


def _ate_per_frame(record: RunRecord) -> dict[int, float]:
    ate, _, _ = _trajectory_errors(record)
    known = [r.index for r in record.reports if r.index in record.truth]
    return {} if ate is None else dict(zip(known, (100.0 * ate.per_frame).tolist(), strict=True))


def _mean(values: Iterable[float]) -> float | None:
    listed = list(values)
    return float(np.mean(listed)) if listed else None


def _percentile(values: list[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None


def _remove_outputs(folder: Path) -> None:
    for name in OUTPUTS:
        (folder / name).unlink(missing_ok=True)
    for path in (folder / "renders").glob("frame[0-9]*_*.png"):
        path.unlink()


def _link_latest(folder: Path) -> None:
    link = Path("runs") / "latest"
    try:
        if link.is_symlink():
            link.unlink()
        if not link.exists():
            link.symlink_to(os.path.relpath(folder, link.parent), target_is_directory=True)
    except OSError:
        pass  # a file system without links: the run itself does not need it
