# SPDX-License-Identifier: Apache-2.0
"""Cutting an object's Gaussians back to where views show the object.

At the end of what is seen of a surface a Gaussian may grow on behind something else, where no picture holds
it back: in the map that does not show, on the object alone it is a tail.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ggwarp.editing.map_view import MapView, best_views
from ggwarp.geometry import se3
from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float32, Float64

Bools = NDArray[np.bool_]

_VIEWS = 40
_OWN = 0.5  # of a pixel: that much of the object, and the object is what is seen
_TOLERANCE = 0.015  # metres and share of the depth, within which a place is on the surface seen
_ENDS = 2.0  # standard deviations from a Gaussian's centre, between which it is to be seen
_PLACES = 9  # looked at along each axis, the centre among them


def trimmed(view: MapView, selected: Bools, poses: Float64) -> Gaussians:
    """Return the ``selected`` Gaussians [n] of a map, each as long as views show it to be.

    A place is seen where some view has it on the surface, in a pixel that is the object's. Along each axis a
    Gaussian is cut to the part between the outermost places seen; one of which nothing is seen stays.

    Args:
        view: the whole map.
        poses: [m, 4, 4] camera-to-world, from which the map was made.
    """
    own = view.gaussians.take(selected)
    indices = best_views(view, poses, selected, count=_VIEWS)
    surfaces = [(poses[i], _surface(view, poses[i], selected)) for i in indices]
    if not surfaces:
        return own
    axes = se3.matrices_from_quats(own.quats)
    means, log_scales = own.means.astype(np.float64), own.log_scales.copy()
    places = np.linspace(-_ENDS, _ENDS, _PLACES)
    for k in range(3):
        along = np.exp(own.log_scales[:, k, None].astype(np.float64)) * axes[:, :, k]
        points = own.means[:, None] + places[:, None] * along[:, None]
        seen = _seen(points.reshape(-1, 3), view, surfaces).reshape(len(own), _PLACES)
        low, high = np.where(seen, places, np.inf).min(axis=1), np.where(seen, places, -np.inf).max(axis=1)
        cut = seen.any(axis=1) & (high - low < 2.0 * _ENDS)
        # It ends half way between the last place seen and the first that is not.
        half = 0.5 * (places[1] - places[0])
        low = np.where(cut, np.maximum(low - half, -_ENDS), -_ENDS)
        high = np.where(cut, np.minimum(high + half, _ENDS), _ENDS)
        means += 0.5 * (low + high)[:, None] * along
        log_scales[:, k] += np.log((high - low) / (2.0 * _ENDS)).astype(np.float32)
    return dataclasses.replace(own, means=means.astype(np.float32), log_scales=log_scales)


def _surface(view: MapView, T_wc: Float64, selected: Bools) -> Float32:
    """Return [h, w] the depth of what ``T_wc`` shows where that is the object, metres; elsewhere -inf."""
    shown = view.render(T_wc, window=view.window_of(T_wc, selected)).surface_depth
    return np.where(view.coverage(T_wc, selected)[0] > _OWN, shown, np.float32(-np.inf))


def _seen(points: Float64, view: MapView, surfaces: list[tuple[Float64, Float32]]) -> Bools:
    """Return [n] which of ``points`` [n, 3] some view has on the object's surface, or before it."""
    seen = np.zeros(len(points), bool)
    for T_wc, depth in surfaces:
        left = np.nonzero(~seen)[0]
        local = se3.transform_points(se3.inverse(T_wc), points[left])
        rows, columns, inside = view.camera.pixels_of(local)
        z = local[:, 2]
        seen[left[inside & (z <= depth[rows, columns] + _TOLERANCE * (1.0 + z))]] = True
    return seen
