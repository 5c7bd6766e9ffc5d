# SPDX-License-Identifier: Apache-2.0
"""A frame's object mask with what it takes to read it: where its pixels are in the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.objects.labels import Labels
from ggwarp.types import Float32, Float64

_TOLERANCE = 0.05  # of the depth: a view shows a point that is no farther from its surface


@dataclass(frozen=True)
class PosedDepth:
    """Where a frame's pixels are in the world: depth [h, w], metres, pose T_wc [4, 4] and camera."""

    depth: Float32
    T_wc: Float64
    camera: Camera

    def points(self, pixels: NDArray[np.bool_], most: int) -> Float64:
        """Return [k, 3] at ``most`` points of the surface at ``pixels`` [h, w], world frame, evenly drawn."""
        rows, columns = np.nonzero(pixels & (self.depth > 0.0))
        chosen = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
        return self._points(rows[chosen], columns[chosen])

    def every_point(self, pixels: NDArray[np.bool_]) -> Float64:
        """Return [k, 3] the points at those of ``pixels`` [h, w] that have depth, world frame, row by row."""
        return self._points(*np.nonzero(pixels & (self.depth > 0.0)))

    def _points(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Float64:
        z = self.depth[rows, columns].astype(np.float64)
        p = self.camera.back_project(columns, rows, z)
        return p @ self.T_wc[:3, :3].T + self.T_wc[:3, 3]

    def look_up(self, points: Float64, image: Labels) -> Labels:
        """Return ``image`` [h, w] at those of ``points`` [k, 3] that the view shows."""
        p = (points - self.T_wc[:3, 3]) @ self.T_wc[:3, :3]
        rows, columns, inside = self.camera.pixels_of(p)
        rows, columns, z = rows[inside], columns[inside], p[inside, 2]
        shown = np.abs(self.depth[rows, columns] - z) <= _TOLERANCE * z
        return image[rows[shown], columns[shown]]
