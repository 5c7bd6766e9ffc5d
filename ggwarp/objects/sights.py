# SPDX-License-Identifier: Apache-2.0
"""Views of a map with and without an object, and the rays through their pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp import lie
from ggwarp.objects.view import MapView
from ggwarp.types import Camera, Float32, Float64

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Sight:
    """What one view shows, with the object and how much of it.

    Attributes:
        T_wc: [4, 4] camera-to-world.
        depth: [h, w] of the surface, metres, the object in place.
        coverage: [h, w] the object's share of each pixel, 0..1.
        left: [h, w] opacity of the map without the object.
        left_depth: [h, w] of the surface of the map without the object, metres.
    """

    T_wc: Float64
    depth: Float32
    coverage: Float32
    left: Float32
    left_depth: Float32

    @property
    def blocked(self) -> Bools:
        """[h, w] where the object is what is seen."""
        return self.coverage > 0.5

    @property
    def touched(self) -> Bools:
        """[h, w] where the object is seen at all."""
        return self.coverage > 0.1


def look(whole: MapView, kept: MapView, T_wc: Float64, selected: Bools) -> Sight:
    """Return what ``T_wc`` shows of ``whole``, and of ``kept``, the map without its ``selected`` [n]."""
    after = kept.render(T_wc)
    return Sight(
        T_wc,
        depth=whole.render(T_wc).surface_depth,
        coverage=whole.coverage(T_wc, selected)[0],
        left=after.opacity,
        left_depth=after.surface_depth,
    )


def rays_of(camera: Camera, T_wc: Float64, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Float64:
    """Return [n, 3] world directions of pixels, one unit deep in the camera frame."""
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=1) @ T_wc[:3, :3].T


def project(
    camera: Camera, T_wc: Float64, points: NDArray[np.floating]
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float64, Bools]:
    """Return the rows, columns and depths of ``points`` [n, 3], and which are inside the image."""
    x, y, z = lie.transform_points(lie.inverse(T_wc), points).T
    front = z > 0.05
    depth = np.where(front, z, 1.0)
    columns = np.rint(camera.fx * x / depth + camera.cx).astype(np.intp)
    rows = np.rint(camera.fy * y / depth + camera.cy).astype(np.intp)
    inside = front & (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    return np.where(inside, rows, 0), np.where(inside, columns, 0), z, inside
