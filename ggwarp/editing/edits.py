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


def relabel(objects: Sequence[ObjectRecord], object_id: int, name: str) -> tuple[ObjectRecord, ...]:
    """Return ``objects`` with the label of ``object_id`` set to ``name``; empty takes it away."""
    return tuple(dataclasses.replace(o, label=name or None) if o.id == object_id else o for o in objects)
