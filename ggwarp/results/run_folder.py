# SPDX-License-Identifier: Apache-2.0
"""The run folder: what a run leaves, file by file.

``trajectory.txt``, ``trajectory_live.txt``, ``trajectory_gt.txt``, ``map.ply``, ``view.json``,
``objects.json``, ``classifier.npz``, ``metrics.json``, ``frames.csv``, ``object_scores.csv`` and
``renders/``; the command adds ``config.toml`` and ``camera.json``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import write_camera
from ggwarp.io.json import write_json
from ggwarp.io.ply import write_ply_parts
from ggwarp.io.table import write_table
from ggwarp.io.trajectory import write_tum
from ggwarp.map.gaussians import Gaussians, join
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.objects.linear_classifier import LinearClassifier, write_classifier
from ggwarp.results.metrics import ate_per_frame
from ggwarp.results.record import RunRecord
from ggwarp.results.scene_view import describe_view, write_view
from ggwarp.types import Float64, StepReport, Verdict

OUTPUTS = (
    "config.toml",
    "camera.json",
    "trajectory.txt",
    "trajectory_live.txt",
    "trajectory_gt.txt",
    "map.ply",
    "view.json",
    "objects.json",
    "classifier.npz",
    "metrics.json",
    "frames.csv",
    "object_scores.csv",
    "report.html",
)
"""The files of a run folder, renders aside."""

FRAME_COLUMNS: tuple[str, ...] = (
    "index",
    "timestamp",
    "verdict",
    "reason",
    "overlap",
    "rmse_mm",
    "depth_noise_mm",
    "position_std_cm",
    "keyframe",
    "tracking_ms",
    "mapping_ms",
    "mapping_iterations",
    "latency_ms",
    "late_ms",
    "frames_behind",
    "loop_ms",
    "loop_with",
    "loop_moved_cm",
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


def write_trajectory(folder: Path, reports: Sequence[StepReport]) -> None:
    """Write ``trajectory.txt``."""
    write_tum(folder / "trajectory.txt", [r.timestamp for r in reports], [r.T_wc for r in reports])


def write_trajectories(folder: Path, record: RunRecord) -> None:
    """Write ``trajectory.txt``, as finally estimated, and ``trajectory_live.txt``, as tracked.

    Where any true pose is known, ``trajectory_gt.txt``, too.
    """
    reports = record.reports
    write_trajectory(folder, reports)
    live = [record.live.get(r.index, r.T_wc) for r in reports]
    write_tum(folder / "trajectory_live.txt", [r.timestamp for r in reports], live)
    known = [r for r in reports if r.index in record.truth]
    if known:
        poses = [record.truth[r.index] for r in known]
        write_tum(folder / "trajectory_gt.txt", [r.timestamp for r in known], poses)


Parts = Callable[[], Iterable[Gaussians]]
"""Gives a map part by part, again whenever it is called."""


def write_map(folder: Path, parts: Parts) -> int:
    """Write ``map.ply``; return how many Gaussians it has."""
    return write_ply_parts(folder / "map.ply", parts)


def outline(parts: Parts) -> Gaussians:
    """Return all of a map, but of each Gaussian no more than a view of it needs."""
    unneeded = dict.fromkeys(("object_ids", "identities", "keyframe_ids", "votes"))
    return join(*(replace(part, **unneeded) for part in parts()))


def write_first_view(
    folder: Path, gaussians: Gaussians, camera: Camera, reports: Sequence[StepReport]
) -> None:
    """Write ``view.json``, by the frames that are not lost, if there are any; nothing without frames."""
    poses = [r.T_wc for r in reports if r.verdict is not Verdict.LOST] or [r.T_wc for r in reports]
    if poses:
        write_view(folder, describe_view(gaussians, camera, np.stack(poses)))


def write_objects(folder: Path, objects: list[ObjectRecord]) -> None:
    """Write ``objects.json``."""
    write_json(folder / "objects.json", {"objects": [record.to_json() for record in objects]})


def write_identities(folder: Path, classifier: LinearClassifier | None) -> None:
    """Write ``classifier.npz`` where there are identities."""
    if classifier is not None:
        write_classifier(folder / "classifier.npz", classifier)


class System(Protocol):
    """What a SLAM system tells of itself at the end."""

    reports: list[StepReport]
    camera: Camera

    def fitted_poses(self) -> dict[int, Float64]: ...
    def map_parts(self) -> Iterable[Gaussians]: ...
    def objects(self, names: dict[int, str]) -> list[ObjectRecord]: ...
    def linear_classifier(self) -> LinearClassifier | None: ...


def write_system(folder: Path, system: System, names: dict[int, str]) -> None:
    """Write what :func:`ggwarp.results.saved_run.load_run` reads.

    Args:
        folder: made where it is not there; files of these names in it are replaced.
        system: from its first frame to its last.
        names: the objects' classes by id, where known.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    poses = system.fitted_poses()
    reports = [replace(r, T_wc=poses[r.index]) for r in system.reports]
    write_trajectory(folder, reports)
    write_camera(folder / "camera.json", system.camera)
    write_map(folder, system.map_parts)
    write_first_view(folder, outline(system.map_parts), system.camera, reports)
    write_objects(folder, system.objects(names))
    write_identities(folder, system.linear_classifier())


def write_frames(folder: Path, record: RunRecord) -> None:
    """Write ``frames.csv``: a row for every frame of the run, skipped ones included."""
    scores = {s.index: s for s in record.evaluation.per_frame}
    errors = ate_per_frame(record)
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
