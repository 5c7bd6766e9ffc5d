# SPDX-License-Identifier: Apache-2.0
"""Pictures of the planes behind an object: as the views saw them, and made up where none did."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.editing.inpaint.holes import PlaneHole
from ggwarp.editing.inpaint.image_inpainting import CONTEXT, Inpaint, Picture, relighting
from ggwarp.editing.inpaint.object_views import ObjectView, world_pixels
from ggwarp.editing.inpaint.shade import Shade
from ggwarp.editing.map_view import crop_to
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float32, Float64

Bools = NDArray[np.bool_]

_SEEN = 3 * CONTEXT  # cells round the needed ones that the inpainter sees
_COARSE = 6  # cells between which an object's shade is taken to be even
_SHARPEST = 2.0  # by this power views that show a surface better count more


@dataclass(frozen=True)
class Surface:
    """A hole's plane, painted.

    Attributes:
        hole: the plane and its cells.
        rgb: [rows + 2 margin, columns + 2 margin, 3] its picture, a pixel a cell, rows as the cells'.
        margin: cells round the hole's grid.
        gain: [rows + 2 margin, columns + 2 margin] by how much it is brighter than it was seen.
    """

    hole: PlaneHole
    rgb: Picture
    margin: int
    gain: Float32

    def colours(self, points: Float64) -> Float32:
        """Return [n, 3] the picture's colours (0..255) at ``points`` [n, 3] on the plane."""
        return sampled(self.rgb, *self._cells(points)[:, :2].T)

    def gains(self, points: NDArray[np.floating], reach: NDArray[np.floating] | float) -> Float32:
        """Return [n] the gain at ``points`` [n, 3]; 1 beyond the picture and ``reach`` metres off it."""
        at = self._cells(points)
        rows, columns = self.gain.shape
        own = (at[:, :2] > 0.0).all(axis=1) & (at[:, :2] < (columns - 1, rows - 1)).all(axis=1)
        own &= np.abs(at[:, 2]) < reach
        gains = np.ones(len(at), np.float32)
        gains[own] = sampled(self.gain[..., None], *at[own, :2].T)[:, 0]
        return gains

    def _cells(self, points: NDArray[np.floating]) -> Float64:
        """Return [n, 3] column and row in the picture, and metres over the plane."""
        at = self.hole.plane.coordinates(points)
        at[:, :2] = (at[:, :2] - self.hole.low) / self.hole.cell + self.margin
        return at


def paint(
    hole: PlaneHole,
    views: list[ObjectView],
    camera: Camera,
    inpaint: Inpaint,
    *,
    margin: int,
    tolerance: float,
    shade: Shade | None = None,
) -> Surface:
    """Return the plane of ``hole`` as the views show it, seen head-on, what is missing inpainted.

    Args:
        margin: cells round the hole that the inpainter sees.
        tolerance: what a view shows lies on the plane within this, metres and share of the depth.
        shade: the object's, which is taken off; None: it stays.
    """
    rows, columns = (size + 2 * margin for size in hole.states.shape)
    at = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) - margin
    points = hole.plane.points(hole.low + hole.cell * at)
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    for view in views:
        index, colours = _shown(points, view, camera, tolerance)
        towards = view.T_wc[:3, 3] - points[index]
        distance = np.linalg.norm(towards, axis=1)
        # Nearer and less slanted views show more of a surface.
        share = (np.clip(towards @ hole.plane.normal / distance, 0.0, 1.0) / distance) ** _SHARPEST
        total[index] += share[:, None] * colours
        weight[index] += share
    known = weight > 0.0
    rgb = np.divide(total, weight[:, None], out=np.zeros_like(total), where=known[:, None])
    needed = np.pad(hole.needed, margin)
    unknown = ~known.reshape(rows, columns) | needed
    picture = np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8).reshape(rows, columns, 3)
    # What lies far off matters to none of the needed cells, and costs much.
    part = crop_to(needed, margin=_SEEN)
    near = np.ascontiguousarray(picture[part])
    gain = np.ones((rows, columns), np.float32)
    if shade is not None:
        lost = _lost(shade, points.reshape(rows, columns, 3)[part], hole.plane.axes)
        gain[part] = relighting(near, ~unknown[part], lost)
        near = np.rint(np.minimum(near * gain[part][..., None], 255.0)).astype(np.uint8)
    picture[part] = inpaint(near, np.ascontiguousarray(unknown[part]), np.ascontiguousarray(needed[part]))
    return Surface(hole, picture, margin, gain)


def _lost(shade: Shade, points: Float64, axes: Float64) -> Float32:
    """Return [rows, columns] the share of light kept from ``points`` [rows, columns, 3], some looked at."""
    few = points[::_COARSE, ::_COARSE]
    shares = shade.lost(few.reshape(-1, 3), axes).reshape(few.shape[:2])
    rows, columns = np.indices(points.shape[:2]) / _COARSE
    return sampled(shares[..., None], columns.ravel(), rows.ravel()).reshape(points.shape[:2])


def _shown(
    points: Float64, view: ObjectView, camera: Camera, tolerance: float
) -> tuple[NDArray[np.intp], Float32]:
    """Return which of ``points`` [n, 3] a view shows, apart from the object, and their colours (0..1)."""
    rows, columns, z, inside = world_pixels(camera, view.T_wc, points)
    mixed = cv2.dilate(view.touched.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    agree = np.abs(view.depth[rows, columns] - z) <= tolerance * (1.0 + z)
    index = np.nonzero(inside & agree & ~mixed[rows, columns])[0]
    pixels, _ = camera.project(se3.transform_points(se3.inverse(view.T_wc), points[index]))
    return index, sampled(view.rgb, *pixels.T)


def sampled(picture: NDArray[Any], columns: Float64, rows: Float64) -> Float32:
    """Return [n, 3] ``picture`` [h, w, 3] between pixels, at ``columns`` and ``rows`` [n]; beyond, its rim.

    OpenCV's ``remap`` takes no more than 32,767 points.
    """
    height, width = picture.shape[:2]
    x, y = np.clip(columns, 0, width - 1), np.clip(rows, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    a, b = (x - left)[:, None], (y - top)[:, None]
    upper = (1.0 - a) * picture[top, left] + a * picture[top, left + 1]
    lower = (1.0 - a) * picture[top + 1, left] + a * picture[top + 1, left + 1]
    return ((1.0 - b) * upper + b * lower).astype(np.float32)
