# SPDX-License-Identifier: Apache-2.0
"""Views of a saved map: its picture, and how much of each pixel is one object."""

from __future__ import annotations

import copy
import heapq
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.editing.windows import footprints, window_round
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.raster.project import Window
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32, Float64, Rendered

Bools = NDArray[np.bool_]

_MOST_POSES = 150  # looked at in search of good views
_CUT = 0.25  # what a view counts that cuts the object
_APART = 0.25  # metres plus radians between chosen views


class MapView:
    """Renders one map, without identities, for one camera."""

    def __init__(self, gaussians: Gaussians, camera: Camera, *, device: Any = "cpu") -> None:
        """Upload ``gaussians``, which are kept, to ``device``."""
        self.gaussians, self.camera = gaussians, camera
        self._map = GaussianMap(device=device, has_identity=False, capacity=max(1, len(gaussians)))
        self._map.append(gaussians)
        self._renderer = Renderer(self._map, camera)
        self._painted = wp.zeros_like(self._map.fields["colours"])

    def through(self, camera: Camera) -> MapView:
        """Return the same map's views through another camera; the map is not uploaded again."""
        other = copy.copy(self)
        other.camera, other._renderer = camera, Renderer(self._map, camera)
        return other

    def render(self, T_wc: Float64, *, window: Window | None = None) -> Rendered:
        """Return the map's view from ``T_wc`` [4, 4]; nothing outside of a ``window``, of whole tiles."""
        self._renderer.render(T_wc, window=window)
        return self._renderer.picture()

    def coverage(self, T_wc: Float64, *selections: Bools) -> Float32:
        """Return [k, h, w] how much of each pixel is made of each of up to three ``selections`` [n].

        It is the selection's share of the blended picture, 0..1, with all that hides it in place.
        """
        window = self.window_of(T_wc, np.any(selections, axis=0))
        if window is None:
            return np.zeros((len(selections), self.camera.height, self.camera.width), np.float32)
        paint = np.zeros((self._map.capacity, 3), np.float32)
        for channel, selected in enumerate(selections):
            paint[: self._map.count, channel] = selected
        with self._painted_with((paint - 0.5) / SH_C0):
            self._renderer.render(T_wc, window=window)
        return self._renderer.plane(self._renderer.image)[: len(selections)]

    def window_of(self, T_wc: Float64, selected: Bools) -> Window | None:
        """Return the tiles of the view that the ``selected`` [n] may reach into; None: none."""
        own = replace(self.gaussians, identities=None).take(selected)  # they are most of the bytes
        return window_round(footprints(own, self.camera, T_wc), self.camera)

    def weights(self, T_wc: Float64, *pixels: Bools, window: Window | None = None) -> Float32:
        """Return [k, n] how many pixels' worth of picture each Gaussian makes up, in each of ``pixels``.

        They are sums of blending weights, all that hides a Gaussian in place: a colour's gradient of the
        picture's sum.

        Args:
            T_wc: [4, 4] camera-to-world.
            pixels: each [h, w], the pixels that count; up to three.
            window: of whole tiles; what lies outside counts for nothing.
        """
        r, camera = self._renderer, self.camera
        d_image = np.zeros(r.d_image.shape, np.float32)
        for channel, counted in enumerate(pixels):
            d_image[channel, : camera.height, : camera.width] = counted
        # A colour at which none is cut off at black, where it would have no gradient.
        with self._painted_with(np.zeros((self._map.capacity, 3), np.float32)):
            r.render(T_wc, window=window)
            r.d_image.assign(d_image)
            r.adjoint(r.pose_array(T_wc))
        shown = to_host(r.ranks)[: self._map.count] >= 0
        found = to_host(r.gradients.colours)[: self._map.count].T[: len(pixels)] / SH_C0
        return np.where(shown, found, np.float32(0.0))

    @contextmanager
    def _painted_with(self, colours: Float32) -> Iterator[None]:
        """Have the Gaussians ``colours`` [capacity, 3] for a while."""
        fields, own = self._map.fields, self._map.fields["colours"]
        self._painted.assign(colours)
        fields["colours"] = self._painted
        try:
            yield
        finally:
            fields["colours"] = own


def best_views(view: MapView, poses: Float64, selected: Bools, *, count: int) -> list[int]:
    """Return up to ``count`` of ``poses`` that show the selected Gaussians largest and from several sides.

    Args:
        poses: [m, 4, 4] camera-to-world.
        selected: [n] which Gaussians of the map.

    Returns:
        Indices into ``poses``, best first; none when no pose shows them.
    """
    own = view.gaussians.take(selected)
    inside = [i for i, T_wc in enumerate(poses) if _in_sight(view.camera, T_wc, own.means)]
    inside = inside[:: -(-len(inside) // _MOST_POSES)] if inside else []
    # Largest first, by a bound until it is rendered: many are too near to one chosen before that.
    waiting = [(-_most_area(own, view.camera, poses[i]), i, False) for i in inside]
    heapq.heapify(waiting)
    chosen: list[int] = []
    while waiting and len(chosen) < count:
        area, i, rendered = heapq.heappop(waiting)
        if area == 0.0 or not all(_apart(poses[i], poses[j]) for j in chosen):
            continue
        if rendered:
            chosen.append(i)
        else:
            heapq.heappush(waiting, (-_shown_area(view.coverage(poses[i], selected)[0]), i, True))
    return chosen


def crop_to(mask: Bools, *, margin: int) -> tuple[slice, slice]:
    """Return rows and columns of the box round ``mask`` [h, w], ``margin`` wider; all if it is empty."""
    if not mask.any():
        return slice(None), slice(None)
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + 1 + margin),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + 1 + margin),
    )


def _in_sight(camera: Camera, T_wc: Float64, points: Float32) -> bool:
    some = points[:: max(1, len(points) // 500)]
    return bool(camera.pixels_of(se3.transform_points(se3.inverse(T_wc), some))[2].any())


def _most_area(own: Gaussians, camera: Camera, T_wc: Float64) -> float:
    """Pixels that ``own`` may cover at most."""
    x0, y0, x1, y1 = window_round(footprints(own, camera, T_wc), camera) or (0, 0, 0, 0)
    return float((x1 - x0) * (y1 - y0))


def _shown_area(coverage: Float32) -> float:
    """Pixels covered; less where the image's border cuts the object."""
    area = float(coverage.sum())
    edges = (coverage[0], coverage[-1], coverage[:, 0], coverage[:, -1])
    cut = sum(float(edge.sum()) for edge in edges)
    return area if area > 10.0 * cut else area * _CUT


def _apart(one: Float64, other: Float64) -> bool:
    between = se3.se3_log(se3.inverse(one) @ other)
    return float(np.linalg.norm(between[:3]) + np.linalg.norm(between[3:])) > _APART
