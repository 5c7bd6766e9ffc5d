# SPDX-License-Identifier: Apache-2.0
"""Filling the holes that an object's removal opens.

What the object hid goes with it: Gaussians that were never seen apart from it. The planes behind it
(``holes``) are seen head-on, as the views show them (``plane_texture``); what is missing in that picture is
inpainted and laid out as new Gaussians. Where there is no plane, depth and colour are inpainted in the views
themselves. The new Gaussians and those at the rim are then fitted to the views, with the inpainted surfaces
in place of the object and all else as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.editing.edits import remove
from ggwarp.editing.inpaint.fitting import RefitConfig, WantedView, fit
from ggwarp.editing.inpaint.holes import HoleConfig, PlaneHole, find_holes, hits
from ggwarp.editing.inpaint.image_inpainting import Inpaint, inpaint_depth, inpaint_shade
from ggwarp.editing.inpaint.object_views import ObjectView, share_in_the_clear, view_object, world_rays
from ggwarp.editing.inpaint.plane_texture import Surface, paint
from ggwarp.editing.inpaint.shade import Shade
from ggwarp.editing.map_view import MapView, best_views
from ggwarp.editing.progress import Progress, part_of, silent
from ggwarp.editing.windows import window_of
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import SH_C0, Gaussians, join
from ggwarp.types import Float32, Float64

Bools = NDArray[np.bool_]

_HOLE = 0.5  # less opaque is a hole
_CLEAR, _SURFACES, _FITTING = (0.1, 0.5), 0.6, 0.75  # of the work's time, where each part lies


@dataclass(frozen=True)
class FillConfig:
    """How holes are filled."""

    views: int = 40
    """Views of the object that are looked at, at most."""
    least_seen: float = 0.5
    """Gaussians of which less was ever seen apart from the object go with it."""
    margin: int = 24
    """Cells round a plane's hole that the inpainter sees."""
    spread: float = 0.6
    """Standard deviation of a new Gaussian along the surface in units of the distance to its neighbours."""
    flatness: float = 0.2
    """Standard deviation along the normal, relative to that along the surface."""
    opacity: float = 0.95
    """Of new Gaussians."""
    shade: bool = True
    """Surfaces lose the shade that the object cast on them."""
    rest_views: int = 3
    """Views in which what no plane fills is inpainted."""
    rest_share: float = 0.01
    """Less of the object's pixels than this share is not worth that."""
    holes: HoleConfig = field(default_factory=HoleConfig)
    fit: RefitConfig = field(default_factory=RefitConfig)


def fill_removed(
    whole: Gaussians,
    removed: Bools,
    camera: Camera,
    poses: Float64,
    *,
    inpaint: Inpaint = inpaint_shade,
    config: FillConfig = FillConfig(),
    device: Any = "cpu",
    progress: Progress = silent,
) -> tuple[Gaussians, int]:
    """Return ``whole`` without the ``removed`` Gaussians, the holes behind them filled, and by how many.

    The new Gaussians come last; of the others only those change that lie on a hole,
    and only those go that do or that the object hid.

    Args:
        whole: the map.
        removed: [n] which Gaussians go.
        camera: of the run's images.
        poses: [m, 4, 4] camera-to-world, from which the map was made.
        inpaint: makes up what a picture lacks; see :mod:`ggwarp.editing.inpaint.image_inpainting`.
        progress: told how far the work is.
    """
    kept = remove(whole, removed)
    progress("looking for views", 0.0)
    view, rest = MapView(whole, camera, device=device), MapView(kept, camera, device=device)
    indices = best_views(view, poses, removed, count=config.views)
    if not indices or not len(kept):
        return kept, 0
    poses_of_views = [poses[i] for i in indices]
    coverages = [view.coverage(T_wc, removed)[0] for T_wc in poses_of_views]
    clear = part_of(progress, *_CLEAR)
    seen, behind = share_in_the_clear(view, rest, poses_of_views, coverages, removed, progress=clear)
    hidden = behind & (seen < config.least_seen)
    if hidden.all():
        return kept, 0
    kept = remove(kept, hidden)
    rest = MapView(kept, camera, device=device)
    progress("looking at what is behind", _CLEAR[1])
    object_views = [
        view_object(view, rest, T_wc, coverage)
        for T_wc, coverage in zip(poses_of_views, coverages, strict=True)
    ]
    progress("laying out surfaces", _SURFACES)
    holes = find_holes(kept, object_views, camera, config.holes)
    # What lies on a hole, though no view ever saw it rightly, makes room.
    kept = remove(kept, _over(holes, kept, config))
    on_plane = config.holes.tolerance
    shade = Shade.of(whole, removed) if config.shade else None
    surfaces = [
        paint(h, object_views, camera, inpaint, margin=config.margin, tolerance=on_plane, shade=shade)
        for h in holes
    ]
    kept = _relit(kept, surfaces, config)
    nearest = _nearest(kept)
    filled = join(kept, *(_laid_out(nearest, surface, config) for surface in surfaces))
    filled = _fill_rest(filled, object_views, camera, inpaint, config, device)
    free = _over(holes, filled, config)
    free[len(kept) :] = True
    wanted = _wanted_views(filled, surfaces, object_views, camera, config, device)
    fitting = part_of(progress, _FITTING, 1.0)
    fitted = fit(filled, free, wanted, camera, config.fit, device=device, progress=fitting)
    return fitted, len(filled) - len(kept)


def _over(holes: list[PlaneHole], gaussians: Gaussians, config: FillConfig) -> Bools:
    """Return [n] the Gaussians that lie on a hole."""
    over = np.zeros(len(gaussians), bool)
    for hole in holes:
        above = hole.plane.coordinates(gaussians.means)[:, 2]
        over |= hole.needs(gaussians.means) & (np.abs(above) < 2.0 * config.holes.reach)
    return over


def _relit(gaussians: Gaussians, surfaces: list[Surface], config: FillConfig) -> Gaussians:
    """Return ``gaussians`` with those on ``surfaces`` as bright as these are without the object."""
    gains = np.ones(len(gaussians), np.float32)
    for surface in surfaces if config.shade else ():
        gains = np.maximum(gains, surface.gains(gaussians.means, 2.0 * config.holes.reach))
    half = np.float32(0.5)
    rgb = np.float32(SH_C0) * gaussians.colours + half
    bright = np.minimum(rgb * gains[:, None], np.maximum(rgb, 1.0))
    colours = np.where(gains[:, None] > 1.0, (bright - half) / np.float32(SH_C0), gaussians.colours)
    return replace(gaussians, colours=colours)


def _nearest(gaussians: Gaussians) -> Callable[[Float64], Gaussians]:
    """Return what finds the nearest of ``gaussians`` to points [n, 3]."""
    from scipy.spatial import KDTree  # heavy, and only needed where there is something to fill

    tree: Any = KDTree(gaussians.means)
    return lambda points: gaussians.take(np.asarray(tree.query(points)[1], np.intp))


def _laid_out(nearest: Callable[[Float64], Gaussians], surface: Surface, config: FillConfig) -> Gaussians:
    """Return Gaussians that carry the hole's part of ``surface``, one a cell and a cell beyond its rim."""
    hole = surface.hole
    place = cv2.dilate(hole.needed.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    points = hole.centres(place)
    quats = np.tile(se3.quat_from_matrix(hole.plane.axes), (len(points), 1))
    spreads = np.full(len(points), config.spread * hole.cell)
    return _new_gaussians(nearest(points), points, quats, spreads, surface.colours(points), config)


def _fill_rest(
    filled: Gaussians,
    object_views: list[ObjectView],
    camera: Camera,
    inpaint: Inpaint,
    config: FillConfig,
    device: Any,
) -> Gaussians:
    """Fill what no plane fills from the views, one after another."""
    for object_view in object_views[: config.rest_views]:
        seen = MapView(filled, camera, device=device).render(object_view.T_wc)
        hole = object_view.touched & (seen.opacity < _HOLE)
        if hole.sum() <= config.rest_share * object_view.touched.sum() or hole.all():
            continue
        unknown = cv2.dilate(hole.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        depth = inpaint_depth(seen.surface_depth, unknown | (seen.opacity < _HOLE))
        picture = inpaint(np.rint(255.0 * seen.rgb).astype(np.uint8), unknown, unknown)
        rows, columns = np.nonzero(hole & (depth > 0.0))
        z = depth[rows, columns]
        points = object_view.T_wc[:3, 3] + world_rays(camera, object_view.T_wc, rows, columns) * z[:, None]
        quats = np.tile(se3.quat_from_matrix(object_view.T_wc[:3, :3]), (len(points), 1))
        spreads = config.spread * z / camera.fx
        near = _nearest(filled)(points)
        new = _new_gaussians(near, points, quats, spreads, picture[rows, columns], config)
        filled = join(filled, new)
    return filled


def _new_gaussians(
    kin: Gaussians,
    points: Float64,
    quats: Float64,
    spreads: NDArray[np.floating],
    colours: NDArray[Any],
    config: FillConfig,
) -> Gaussians:
    """Return flat Gaussians at ``points`` [n, 3] that belong to what ``kin`` [n] belong to.

    Args:
        quats: [n, 4] their axes, the normal last. spreads: [n] metres. colours: [n, 3] in 0..255.
    """
    scales = np.stack([spreads, spreads, config.flatness * spreads], axis=1)
    return replace(
        kin,
        means=points.astype(np.float32),
        quats=quats.astype(np.float32),
        log_scales=np.log(scales).astype(np.float32),
        opacity_logits=np.full(len(points), np.log(config.opacity / (1.0 - config.opacity)), np.float32),
        colours=((colours / 255.0 - 0.5) / SH_C0).astype(np.float32),
    )


def _wanted_views(
    filled: Gaussians,
    surfaces: list[Surface],
    object_views: list[ObjectView],
    camera: Camera,
    config: FillConfig,
    device: Any,
) -> list[WantedView]:
    """Return what each view should show: the painted surfaces where the object was, all else as it is."""
    view = MapView(filled, camera, device=device)
    holes = [surface.hole for surface in surfaces]
    shaded = [surface for surface in surfaces if (surface.gain > 1.0).any()]
    wanted = []
    for object_view in object_views[: config.fit.views]:
        seen = view.render(object_view.T_wc, window=window_of(object_view.touched, camera))
        whole = np.where(object_view.touched[..., None], seen.rgb, object_view.rgb)
        rgb = np.rint(255.0 * whole).astype(np.uint8)
        depth = np.where(object_view.touched, seen.surface_depth, object_view.depth)
        rgb = _relit_view(rgb, depth, object_view, shaded, camera, config)
        rows, columns, which, along = hits(holes, object_view, camera, tolerance=config.holes.tolerance)
        points = (
            object_view.T_wc[:3, 3]
            + world_rays(camera, object_view.T_wc, rows, columns) * np.where(which >= 0, along, 0.0)[:, None]
        )
        for k, surface in enumerate(surfaces):
            own = which == k
            rgb[rows[own], columns[own]] = np.rint(surface.colours(points[own]))
            depth[rows[own], columns[own]] = along[own]
        wanted.append(WantedView(object_view.T_wc, rgb, depth))
    return wanted


def _relit_view(
    rgb: NDArray[np.uint8],
    depth: Float32,
    object_view: ObjectView,
    surfaces: list[Surface],
    camera: Camera,
    config: FillConfig,
) -> NDArray[np.uint8]:
    """Return ``rgb`` [h, w, 3] of a view as bright as its ``surfaces`` are where the object is not seen."""
    rows, columns = np.nonzero(~object_view.touched & (depth > 0.0))
    z = depth[rows, columns].astype(np.float64)
    points = object_view.T_wc[:3, 3] + world_rays(camera, object_view.T_wc, rows, columns) * z[:, None]
    gains = np.ones(len(points), np.float32)
    for surface in surfaces:
        gains = np.maximum(gains, surface.gains(points, config.holes.tolerance * (1.0 + z)))
    out = rgb.copy()
    out[rows, columns] = np.rint(np.minimum(rgb[rows, columns] * gains[:, None], 255.0))
    return out
