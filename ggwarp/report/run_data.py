# SPDX-License-Identifier: Apache-2.0
"""What a report tells, read from a run folder; what is not there, or damaged, is left out and said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ggwarp.config.options import changed_options
from ggwarp.config.presets import load_config
from ggwarp.evaluation.trajectory import align
from ggwarp.io.camera import read_camera
from ggwarp.io.guarded import OBJECTS, read_json
from ggwarp.io.ply import read_ply
from ggwarp.io.printable import printable
from ggwarp.io.trajectory import read_tum
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.report.gallery import read_gallery
from ggwarp.results.frame_table import FrameTable, read_frames
from ggwarp.results.saved_run import RunError
from ggwarp.results.scene_view import FILE, SceneView, describe_view, read_view
from ggwarp.types import Float64

T = TypeVar("T")

_MOST_OBJECTS = 300
"""That a page shows."""


@dataclass(frozen=True)
class RunData:
    """A run, as far as its folder tells.

    Attributes:
        folder: of the run.
        metrics: as in ``metrics.json``; empty where there is none.
        frames: all of them, skipped ones too.
        poses: [n, 4, 4] as finally estimated; None: not known.
        live: [n, 3] positions as they were reported, where they differ; None.
        truth: [m, 3] true positions, in the estimate's world (aligned); None.
        objects: of the map.
        scores: object id -> its IoU, 0..1.
        gaussians: the map; None: not known.
        view: which way is up.
        options: flag, value and default of the options that were changed.
        pictures: frame index -> kind -> file. crops: object id -> file.
        faults: what could not be read.
    """

    folder: Path
    metrics: dict[str, Any]
    frames: FrameTable
    poses: Float64 | None = None
    live: Float64 | None = None
    truth: Float64 | None = None
    objects: tuple[ObjectRecord, ...] = ()
    scores: dict[int, float] = field(default_factory=dict)
    gaussians: Gaussians | None = None
    view: SceneView | None = None
    options: tuple[tuple[str, str, str], ...] = ()
    pictures: dict[int, dict[str, Path]] = field(default_factory=dict)
    crops: dict[int, Path] = field(default_factory=dict)
    faults: tuple[str, ...] = ()

    @property
    def largest_objects(self) -> list[ObjectRecord]:
        """Those with the most Gaussians, a few hundred at most."""
        return sorted(self.objects, key=lambda o: -o.count)[:_MOST_OBJECTS]

    @property
    def title(self) -> str:
        """The sequence's name, else the folder's."""
        return str(self.metrics.get("sequence") or self.folder.resolve().name)


def read_run(folder: Path) -> RunData:
    """Read the run in ``folder``.

    Raises:
        RunError: it is no run folder.
    """
    if not folder.is_dir():
        raise RunError(f"{folder}: no such folder; give a run folder, such as runs/latest")
    if not any((folder / name).is_file() for name in ("metrics.json", "trajectory.txt", "config.toml")):
        raise RunError(f"{folder}: has neither metrics.json nor trajectory.txt, so it is no run folder")
    faults: list[str] = []

    def attempt(name: str, read: Callable[[Path], T]) -> T | None:
        if not (folder / name).exists():
            return None
        try:
            return read(folder / name)
        except (ValueError, OSError) as error:
            faults.append(printable(str(error)))
            return None

    trajectory, live = attempt("trajectory.txt", read_tum), attempt("trajectory_live.txt", read_tum)
    poses = trajectory[1] if trajectory is not None and len(trajectory[1]) else None
    gaussians, camera = attempt("map.ply", read_ply), attempt("camera.json", read_camera)
    view = attempt(FILE, lambda path: read_view(path.parent))
    if view is None and poses is not None and gaussians is not None and camera is not None:
        view = describe_view(gaussians, camera, poses)
    pictures, crops = read_gallery(folder)
    return RunData(
        folder,
        attempt("metrics.json", _read_metrics) or {},
        attempt("frames.csv", lambda path: read_frames(path.parent)) or FrameTable([]),
        poses,
        _moved(poses, None if live is None else live[1]),
        _aligned(trajectory, attempt("trajectory_gt.txt", read_tum)),
        attempt("objects.json", _read_objects) or (),
        attempt("object_scores.csv", lambda path: _read_scores(path.parent)) or {},
        gaussians,
        view,
        attempt("config.toml", lambda path: tuple(changed_options(load_config(path)))) or (),
        pictures,
        crops,
        tuple(faults),
    )


def _read_metrics(path: Path) -> dict[str, Any]:
    values = read_json(path, OBJECTS)
    if not isinstance(values, dict):
        raise ValueError(f"{path}: is no metrics.json")
    return values


def _read_objects(path: Path) -> tuple[ObjectRecord, ...]:
    values = read_json(path, OBJECTS)
    try:
        return tuple(ObjectRecord.from_json(entry) for entry in values["objects"])
    except (KeyError, TypeError):
        raise ValueError(f"{path}: is no objects.json") from None


def _read_scores(folder: Path) -> dict[int, float]:
    table = read_frames(folder, "object_scores.csv")
    pairs = zip(table.numbers("id"), table.numbers("iou"), strict=True)
    return {int(i): iou for i, iou in pairs if np.isfinite([i, iou]).all()}


def _moved(poses: Float64 | None, live: Float64 | None) -> Float64 | None:
    """Return the reported positions, where any differs from the final ones."""
    if poses is None or live is None or len(live) != len(poses):
        return None
    same = np.abs(live[:, :3, 3] - poses[:, :3, 3]).max() < 1e-6
    return None if same else live[:, :3, 3]


def _aligned(estimate: tuple[Any, Float64] | None, truth: tuple[Any, Float64] | None) -> Float64 | None:
    """Return the true positions where they come nearest to the estimated ones."""
    if estimate is None or truth is None:
        return None
    rows = {round(float(t), 6): row for row, t in enumerate(estimate[0])}
    pairs = [(rows[key], k) for k, t in enumerate(truth[0]) if (key := round(float(t), 6)) in rows]
    if len(pairs) < 2:
        return None
    at, true = estimate[1][[a for a, _ in pairs], :3, 3], truth[1][:, :3, 3]
    scale, R, t = align(true[[b for _, b in pairs]], at)
    return scale * true @ R.T + t
