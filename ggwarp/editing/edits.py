# SPDX-License-Identifier: Apache-2.0
"""Edits of a map's arrays: pure functions that return new arrays and leave the old ones alone.

``selected`` is always [n] bool, which Gaussians are meant (:func:`ggwarp.editing.selection.select`).
Colours are spherical harmonics of degree 0, the same from every side: nothing of them turns with an object.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.boxes import separate_parts
from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.types import Float64

Bools = NDArray[np.bool_]


def extract(gaussians: Gaussians, selected: Bools) -> Gaussians:
    """Return the selected Gaussians alone."""
    return gaussians.take(selected)


def remove(gaussians: Gaussians, selected: Bools) -> Gaussians:
    """Return the map without the selected Gaussians."""
    return gaussians.take(~selected)


def move(gaussians: Gaussians, selected: Bools, T: ArrayLike) -> Gaussians:
    """Return the map with the selected Gaussians moved by the rigid motion ``T`` [4, 4], world frame.

    Moving by ``T`` and then by its inverse gives the same map to float precision (a rotation by 180
    degrees may turn a quaternion's sign, which means the same).
    """
    T = np.asarray(T, np.float64)
    means, quats = gaussians.means.copy(), gaussians.quats.copy()
    means[selected] = se3.transform_points(T, means[selected])
    quats[selected] = se3.rotate_quats(T[:3, :3], quats[selected])
    return dataclasses.replace(gaussians, means=means, quats=quats)


def motion_about(centre: ArrayLike, *, rotation: ArrayLike, translation: ArrayLike) -> Float64:
    """Return the motion [4, 4] that turns by ``rotation`` [3, 3] about ``centre`` [3], then shifts by
    ``translation`` [3], metres."""
    centre, rotation = np.asarray(centre, np.float64), np.asarray(rotation, np.float64)
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = centre - rotation @ centre + np.asarray(translation, np.float64)
    return T


def recolour(gaussians: Gaussians, selected: Bools, rgb: Sequence[float]) -> Gaussians:
    """Return the map with the selected Gaussians in the colour ``rgb`` (0..255), light and shade kept.

    Each takes on ``rgb`` times its brightness over the mean brightness of all selected.
    """
    colours = gaussians.colours.copy()
    shown = np.clip(0.5 + SH_C0 * colours[selected], 0.0, 1.0)
    brightness = shown @ np.array([0.299, 0.587, 0.114], np.float32)
    shade = brightness / max(float(brightness.mean()), 1e-6) if len(brightness) else brightness
    painted = np.clip(shade[:, None] * np.asarray(rgb, np.float32) / 255.0, 0.0, 1.0)
    colours[selected] = (painted - 0.5) / SH_C0
    return dataclasses.replace(gaussians, colours=colours)


def merge(gaussians: Gaussians, ids: Sequence[int]) -> Gaussians:
    """Return the map with the Gaussians of objects ``ids`` being the first one's.

    Raises:
        ValueError: the map has no object ids.
    """
    if gaussians.object_ids is None:
        raise ValueError("the map has no object ids")
    object_ids = gaussians.object_ids.copy()
    object_ids[np.isin(object_ids, ids)] = ids[0]
    return dataclasses.replace(gaussians, object_ids=object_ids)


def split(
    gaussians: Gaussians, object_id: int, parts: int | None = None, *, first_new: int = 1
) -> tuple[Gaussians, list[int]]:
    """Return the map with the parts of an object as objects of their own, and the new ones' ids.

    The largest part keeps its id; strays go with the part that is nearest.

    Args:
        parts: how many, compact in space (k-means); None: those that are apart from each other
            (:func:`ggwarp.geometry.boxes.separate_parts`), where no new ids mean that there is one.
        first_new: new ids begin here, or beyond those of the map.

    Raises:
        ValueError: the map has no object ids, or the object fewer Gaussians than ``parts``.
    """
    if gaussians.object_ids is None:
        raise ValueError("the map has no object ids")
    own = gaussians.object_ids == object_id
    points = gaussians.means[own].astype(np.float64)
    if parts is not None and not 2 <= parts <= len(points):
        raise ValueError(f"{len(points)} Gaussians make no {parts} parts")
    labels = _nearest_part(points, separate_parts(points)) if parts is None else _clusters(points, parts)
    largest_first = np.argsort(-np.bincount(labels), kind="stable")
    first_new = max(first_new, int(gaussians.object_ids.max()) + 1)
    new = [first_new + k for k in range(len(largest_first) - 1)]
    id_of_part = np.empty(len(largest_first), np.int32)
    id_of_part[largest_first] = [object_id, *new]
    object_ids = gaussians.object_ids.copy()
    object_ids[own] = id_of_part[labels]
    return dataclasses.replace(gaussians, object_ids=object_ids), new


def _nearest_part(points: Float64, parts: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return ``parts`` [n] with -1 replaced by the part of the nearest point that has one."""
    from scipy.spatial import KDTree  # heavy, and only needed here

    inside = parts >= 0
    return parts if inside.all() else parts[inside][KDTree(points[inside]).query(points)[1]]


def _clusters(points: Float64, count: int) -> NDArray[np.int32]:
    """Return [n] the cluster, from 0 on, of each of ``points`` [n, 3]; each has at least one."""
    from scipy.cluster.vq import kmeans2  # heavy, and only needed here

    labels = kmeans2(points, count, minit="++", rng=np.random.default_rng(0))[1]
    return np.unique(labels, return_inverse=True)[1].astype(np.int32)


def relabel(objects: Sequence[ObjectRecord], object_id: int, name: str) -> tuple[ObjectRecord, ...]:
    """Return ``objects`` with the label of ``object_id`` set to ``name``; empty takes it away."""
    return tuple(dataclasses.replace(o, label=name or None) if o.id == object_id else o for o in objects)
