# SPDX-License-Identifier: Apache-2.0
"""What nobody ever saw behind and under an object: the holes that its removal opens.

The surfaces around the object are taken to be planes that go on behind it. A place on one of them
is unseen when every view of it is blocked: a view that shows something there, or through there to
something farther, decides it. Of the unseen places those matter which a view without the object would show.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.editing.inpaint.object_views import ObjectView, world_pixels, world_rays
from ggwarp.editing.inpaint.planes import Plane, fit_planes, surface_normals
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float32, Float64

Bools = NDArray[np.bool_]

FREE, SEEN, UNSEEN = range(3)
"""States of a place on a plane: looked through; its surface seen; neither."""


@dataclass(frozen=True)
class HoleConfig:
    """How holes are found."""

    reach: float = 0.015
    """A Gaussian lies on a plane within this, metres."""
    least_points: int = 25
    """A plane has at least so many Gaussians round the object."""
    planes: int = 8
    """Planes looked for at most."""
    ring: float = 0.35
    """The surroundings reach this far from the object's outline, in units of its size in the picture."""
    tolerance: float = 0.01
    """Depths agree within this, metres, and this share of the depth."""
    cell: float = 0.8
    """Side of a plane's cells in units of the distance between its Gaussians."""
    going_on: float = 1.3
    """A plane has ended where the nearest place looked through is within so many times the way to the nearest
    seen. On a map of the built-in office 1.3 served as well as 1 or better; 2 ended a table top too early."""


@dataclass(frozen=True)
class PlaneHole:
    """The cells of one plane.

    Attributes:
        plane: where it lies.
        low: (a, b) of the first cell's centre.
        cell: side of a cell, metres.
        states: [rows, columns] uint8; b grows with the row, a with the column.
        known: [rows, columns] cells that the plane's Gaussians surround.
        needed: [rows, columns] unseen cells that a view without the object shows.
    """

    plane: Plane
    low: Float64
    cell: float
    states: NDArray[np.uint8]
    known: Bools
    needed: Bools

    def state_at(self, points: Float64, *, beyond: bool) -> NDArray[np.uint8]:
        """Return [n] the states of ``points`` [n, 3] on the plane.

        Outside the grid and, unless ``beyond``, outside the known part, the plane is not: :data:`FREE`.
        """
        rows, columns, inside = self._cells(points)
        if not beyond:
            inside &= self.known[rows, columns]
        return np.where(inside, self.states[rows, columns], np.uint8(FREE))

    def mark(self, points: Float64) -> None:
        """Set ``needed`` at ``points`` [n, 3]."""
        rows, columns, inside = self._cells(points)
        self.needed[rows[inside], columns[inside]] = True

    def needs(self, points: NDArray[np.floating]) -> Bools:
        """Return [n] which of ``points`` [n, 3] lie over needed cells."""
        rows, columns, inside = self._cells(points)
        return inside & self.needed[rows, columns]

    def centres(self, cells: Bools) -> Float64:
        """Return [n, 3] the middles of ``cells`` [rows, columns], in the order of ``nonzero``."""
        rows, columns = np.nonzero(cells)
        return self.plane.points(self.low + self.cell * np.stack([columns, rows], axis=1))

    def _cells(self, points: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.intp], Bools]:
        at = np.rint((self.plane.coordinates(points)[:, :2] - self.low) / self.cell).astype(np.intp)
        rows, columns = at[:, 1], at[:, 0]
        height, width = self.states.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        return np.where(inside, rows, 0), np.where(inside, columns, 0), inside


def find_holes(
    kept: Gaussians, views: list[ObjectView], camera: Camera, config: HoleConfig = HoleConfig()
) -> list[PlaneHole]:
    """Return the planes behind the object that have unseen places, with what is to be filled.

    Args:
        kept: the map without the object.
        views: views that show the object, and others of the place.
        camera: of the views.
    """
    holes = []
    around = _surroundings(kept, views, camera, config)
    points, normals = kept.means[around], surface_normals(kept)[around]
    weights = 1.0 / (1.0 + np.exp(-kept.opacity_logits[around]))
    towards = np.mean([s.T_wc[:3, 3] for s in views], axis=0)
    found = fit_planes(
        points,
        normals,
        weights,
        reach=config.reach,
        least=config.least_points,
        most=config.planes,
        towards=towards,
    )
    for plane, own in found:
        hole = _grid(plane, points[own], views, camera, config)
        if hole is not None:
            holes.append(hole)
    for view in views:
        _mark(holes, view, camera, config.tolerance)
    for hole in holes:
        _close(hole)
    return [hole for hole in holes if hole.needed.any()]


def _surroundings(kept: Gaussians, views: list[ObjectView], camera: Camera, config: HoleConfig) -> Bools:
    """Return [n] the Gaussians that a view shows close to the object's outline."""
    near = np.zeros(len(kept), bool)
    for view in views:
        size = float(np.sqrt(view.blocked.sum()))
        if size == 0.0:
            continue
        width = 2 * round(max(4.0, config.ring * size)) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        ring = cv2.dilate(view.blocked.astype(np.uint8), disc).astype(bool) & ~view.blocked
        rows, columns, z, inside = world_pixels(camera, view.T_wc, kept.means)
        agree = np.abs(view.depth[rows, columns] - z) < 2.0 * config.tolerance * (1.0 + z)
        near |= inside & ring[rows, columns] & agree
    return near


def _grid(
    plane: Plane, own: Float32, views: list[ObjectView], camera: Camera, config: HoleConfig
) -> PlaneHole | None:
    """Lay cells over what the object hides of ``plane``; ``own`` [n, 3] are Gaussians on it."""
    from scipy.spatial import KDTree

    flat = plane.coordinates(own)[:, :2]
    tree: Any = KDTree(flat)
    cell = config.cell * float(np.median(tree.query(flat, k=2)[0][:, 1]))
    cell = min(max(cell, 0.003), 0.03)
    hidden = [plane.coordinates(_behind(plane, view, camera, config))[:, :2] for view in views]
    shadow = np.concatenate(hidden)
    # Rays that graze the plane hit it far away, where nothing says that it still is.
    room = 0.5 * np.ptp(flat, axis=0)
    shadow = shadow[((shadow >= flat.min(0) - room) & (shadow <= flat.max(0) + room)).all(axis=1)]
    if len(shadow) == 0:
        return None
    low = shadow.min(0) - 2.0 * cell
    columns, rows = (np.ceil((shadow.max(0) - low) / cell).astype(int) + 3).tolist()
    known = np.zeros((rows, columns), np.uint8)
    hull = cv2.convexHull(flat.astype(np.float32))[:, 0]
    cv2.fillConvexPoly(known, np.rint((hull - low) / cell).astype(np.int32), 1)
    blank = np.zeros((rows, columns), np.uint8)
    hole = PlaneHole(plane, low, cell, blank, known.astype(bool), np.zeros((rows, columns), bool))
    hole.states[:] = _classified(hole, views, camera, config).reshape(rows, columns)
    hole.states[_ended(hole.states, config.going_on)] = FREE
    return hole


def _ended(states: NDArray[np.uint8], going_on: float) -> Bools:
    """Return the unseen cells that are near to free ones and far from seen ones: there, a plane has ended.

    A door's frame goes on downwards behind a bin, and not sideways, over the wall that it stands out from.
    """
    free = cv2.morphologyEx((states == FREE).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    seen = (states == SEEN).astype(np.uint8)
    if not free.any() or not seen.any():
        return np.zeros(states.shape, bool)
    to_free, to_seen = (
        cv2.distanceTransform(1 - there, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for there in (free, seen)
    )
    return (states == UNSEEN) & (going_on * to_seen > to_free)


def _behind(plane: Plane, view: ObjectView, camera: Camera, config: HoleConfig) -> Float64:
    """Return [n, 3] where rays through the object meet ``plane`` behind the object's front."""
    rows, columns = np.nonzero(view.touched)
    rays, centre = world_rays(camera, view.T_wc, rows, columns), view.T_wc[:3, 3]
    depths = plane.depths(rays, centre)
    behind = np.isfinite(depths) & (depths > view.depth[rows, columns] - config.tolerance)
    return centre + rays[behind] * depths[behind, None]


def _classified(
    hole: PlaneHole, views: list[ObjectView], camera: Camera, config: HoleConfig
) -> NDArray[np.uint8]:
    """Return [cells] what the views say of each cell of ``hole``."""
    points = hole.centres(np.ones(hole.states.shape, bool))
    free, seen = np.zeros(len(points), int), np.zeros(len(points), int)
    for view in views:
        rows, columns, z, inside = world_pixels(camera, view.T_wc, points)
        tolerance = config.tolerance * (1.0 + z)
        beyond = view.depth[rows, columns] - z
        # Where the outline mixes the object with what is behind, neither can be told.
        inside &= view.blocked[rows, columns] | ~view.touched[rows, columns]
        free += inside & (beyond > tolerance)
        seen += inside & (np.abs(beyond) <= tolerance) & ~view.blocked[rows, columns]
    # One view alone may look past an edge that its pixels blur.
    return np.where(free > np.maximum(1, seen), FREE, np.where(seen > 0, SEEN, UNSEEN)).astype(np.uint8)


def hits(
    holes: list[PlaneHole], view: ObjectView, camera: Camera, *, tolerance: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Float64]:
    """Return where the rays through the object meet the holes, as if it were not there.

    Where the map without the object shows nothing, planes are taken to go on beyond their known part.

    Args:
        tolerance: what stands before a hole by more than this, metres and share of its depth, hides it.

    Returns:
        [n] rows and columns of the pixels that show any of the object; [n] index into ``holes`` of the first
        one met, -1 where a known surface comes before or nothing is met; [n] depths, metres, inf: nothing.
    """
    rows, columns = np.nonzero(view.touched)
    which, depth = _first(holes, view.T_wc, camera, rows, columns, beyond=False)
    shown = view.left[rows, columns] > 0.5
    empty = np.isinf(depth) & ~shown
    which[empty], depth[empty] = _first(holes, view.T_wc, camera, rows[empty], columns[empty], beyond=True)
    before = view.left_depth[rows, columns]
    which[shown & (before < depth - tolerance * (1.0 + before))] = -1
    return rows, columns, which, depth


def _first(
    holes: list[PlaneHole],
    T_wc: Float64,
    camera: Camera,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    *,
    beyond: bool,
) -> tuple[NDArray[np.intp], Float64]:
    rays, centre = world_rays(camera, T_wc, rows, columns), T_wc[:3, 3]
    which, depth = np.full(len(rays), -1, np.intp), np.full(len(rays), np.inf)
    for k, hole in enumerate(holes):
        along = hole.plane.depths(rays, centre)
        index = np.nonzero(along < depth)[0]
        states = hole.state_at(centre + rays[index] * along[index, None], beyond=beyond)
        index, states = index[states != FREE], states[states != FREE]
        depth[index] = along[index]
        which[index] = np.where(states == UNSEEN, k, -1)
    return which, depth


def _mark(holes: list[PlaneHole], view: ObjectView, camera: Camera, tolerance: float) -> None:
    rows, columns, which, depth = hits(holes, view, camera, tolerance=tolerance)
    rays, centre = world_rays(camera, view.T_wc, rows, columns), view.T_wc[:3, 3]
    for k, hole in enumerate(holes):
        hole.mark(centre + rays[which == k] * depth[which == k, None])


def _close(hole: PlaneHole) -> None:
    """Join needed cells that a view's pixels step over."""
    closed = cv2.morphologyEx(hole.needed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    hole.needed[:] = closed.astype(bool) & (hole.states == UNSEEN)
