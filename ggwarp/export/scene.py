# SPDX-License-Identifier: Apache-2.0
"""What is exported of a run, in the axes of the program that will open it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggwarp.editing.selection import SelectionConfig, select
from ggwarp.geometry import se3
from ggwarp.geometry.upright import Up
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.results.saved_run import RunError, SavedRun
from ggwarp.types import Float64


@dataclass(frozen=True)
class ExportScene:
    """A run's map, or some of its objects, turned into other axes.

    Attributes:
        run: where it comes from, in its own axes.
        gaussians: what is exported, in the new axes.
        whole: whether that is the whole map.
        poses: [n, 4, 4] camera-to-world, in the new axes.
        objects: those that are exported.
        R: [3, 3] from the run's world to the new axes.
        convention: their name, see :data:`ggwarp.geometry.upright.CONVENTIONS`; world: the run's own.
        up: [3] away from the floor, in the new axes.
    """

    run: SavedRun
    gaussians: Gaussians
    whole: bool
    poses: Float64
    objects: tuple[ObjectRecord, ...]
    R: Float64
    convention: str
    up: Float64

    def name_of(self, identifier: int) -> str:
        """Return what object ``identifier`` is called; 0: everything else."""
        names = {record.id: record.name for record in self.objects}
        return names.get(identifier, f"object {identifier}" if identifier else "rest")


def prepare(run: SavedRun, *, names: Sequence[str], convention: str, up: Up | None) -> ExportScene:
    """Return what is to be exported of ``run``.

    Args:
        names: the objects, by id, label or class; none: the whole map.
        convention: the axes wanted; world: as they are.
        up: where it is known; None: as the run says.

    Raises:
        RunError: there is no such object, or nothing of it, or the map is empty.
    """
    if not len(run.gaussians):
        raise RunError(f"{run.folder}: its map is empty; there is nothing to export")
    view = run.scene_view(up)
    R = np.eye(3) if convention == "world" else view.rotation_to(convention)
    records = tuple(run.find(name) for name in names)
    gaussians = run.gaussians
    if records:
        gaussians = _objects_alone(run, records)
        if not len(gaussians):
            raise RunError(
                f"{', '.join(names)}: the map has nothing of it; `ggwarp objects` lists what it has"
            )
    T = np.eye(4)
    T[:3, :3] = R
    return ExportScene(
        run,
        turned(gaussians, R),
        not records,
        T @ run.poses,
        records or run.objects,
        R,
        convention,
        R @ view.up.direction,
    )


def turned(gaussians: Gaussians, R: Float64) -> Gaussians:
    """Return ``gaussians`` turned about the origin by the rotation ``R`` [3, 3]; of unit rotations."""
    quats = se3.rotate_quats(R, gaussians.quats)
    return dataclasses.replace(
        gaussians,
        means=np.asarray(gaussians.means @ R.T, np.float32),
        quats=np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True), np.float32),
    )


def _objects_alone(run: SavedRun, records: Sequence[ObjectRecord]) -> Gaussians:
    """Return the Gaussians of ``records``, each under its object's id, those it has adopted too."""
    ids = np.zeros(len(run.gaussians), np.int32)
    for record in records:
        config = SelectionConfig(cut_outliers=True)
        ids[select(run.gaussians, record.id, config, classifier=run.classifier)] = record.id
    return dataclasses.replace(run.gaussians, object_ids=ids).take(ids > 0)
