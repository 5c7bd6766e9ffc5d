# SPDX-License-Identifier: Apache-2.0
"""What may be in a camera's view, by balls around it and by how far the view reaches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.camera import NEAR, Camera
from ggwarp.types import Float32, Float64

Bools = NDArray[np.bool_]

ROWS, COLUMNS = 6, 8
"""Parts of a picture, down and across, for each of which it is known how far it reaches."""


def reach_of(depth: Float32) -> Float32:
    """Return [ROWS, COLUMNS] how far the parts of a picture reach, metres, by its depth [h, w]."""
    rows, columns = (_edges(size, parts) for size, parts in zip(depth.shape, (ROWS, COLUMNS), strict=True))
    # Row upon row is several times as fast as numpy.maximum.reduceat, which goes along columns.
    ends = np.maximum(np.append(rows[1:], len(depth)), rows + 1)
    strips = np.stack([depth[begin:end].max(axis=0) for begin, end in zip(rows, ends, strict=True)])
    reach = np.maximum.reduceat(strips, columns, axis=1)
    return reach if np.isfinite(reach).all() else reach_of(np.where(np.isfinite(depth), depth, np.float32(0)))


def median_reading(depth: Float32) -> float:
    """Return the median of the readings in ``depth`` (any shape), metres, the upper of two; 0: of none."""
    readings = depth[depth > 0.0]
    half = len(readings) // 2
    return float(np.partition(readings, half)[half]) if len(readings) else 0.0


def same_reach(reach: float) -> Float32:
    """Return that of a picture that reaches equally far everywhere."""
    return np.full((ROWS, COLUMNS), reach, np.float32)


def _edges(size: int, parts: int) -> NDArray[np.intp]:
    """Return where each of ``parts`` of ``size`` pixels begins; where they are few, some begin as one."""
    return np.minimum(-(-np.arange(parts) * size // parts), size - 1)


class ViewVolume:
    """The pyramid that a camera sees, from its centre to the surfaces that end its view."""

    def __init__(self, camera: Camera) -> None:
        """Take the outermost edges of the picture of ``camera``."""
        self._camera = camera
        left, right = -0.5 - camera.cx, camera.width - 0.5 - camera.cx
        top, bottom = -0.5 - camera.cy, camera.height - 0.5 - camera.cy
        sides = np.array(
            [
                (camera.fx, 0.0, -left),
                (-camera.fx, 0.0, right),
                (0.0, camera.fy, -top),
                (0.0, -camera.fy, bottom),
                (0.0, 0.0, 1.0),
            ]
        )
        self._normals: Float64 = sides / np.linalg.norm(sides, axis=1, keepdims=True)

    def touches(self, T_cw: Float64, reach: Float32, centres: Float64, radii: Float64) -> Bools:
        """Return which balls may be in view, none that is left out by mistake.

        Args:
            T_cw: [..., 4, 4] world to camera.
            reach: [..., ROWS, COLUMNS] how far the parts of each picture reach, metres along its axis.
            centres, radii: [m, 3] and [m], metres, world frame.

        Returns:
            [..., m].
        """
        points = centres @ np.swapaxes(T_cw[..., :3, :3], -1, -2) + T_cw[..., None, :3, 3]
        inside = points[..., 2] <= reach.max(axis=(-2, -1))[..., None] + radii
        for normal in self._normals:
            inside &= points @ normal >= -radii
        # Few are left, for which it matters where in the picture they are.
        *view, ball = np.nonzero(inside)
        inside[inside] = self._reached(points[inside], radii[ball], reach[tuple(view)])
        return inside

    def _reached(self, points: Float64, radii: Float64, reach: Float32) -> Bools:
        """Return [n] which balls begin before the parts of the picture end where they are.

        Args:
            points, radii: [n, 3] and [n] metres, camera frame.
            reach: [ROWS, COLUMNS], or [n, ROWS, COLUMNS].
        """
        c, z = self._camera, points[:, 2]
        (first_column, last_column), (first_row, last_row) = (
            _parts_of(points[:, axis], z, radii, focal, centre, size, parts)
            for axis, focal, centre, size, parts in (
                (0, c.fx, c.cx, c.width, COLUMNS),
                (1, c.fy, c.cy, c.height, ROWS),
            )
        )
        rows, columns = np.arange(ROWS), np.arange(COLUMNS)
        down = (first_row[:, None] <= rows) & (rows <= last_row[:, None])
        across = (first_column[:, None] <= columns) & (columns <= last_column[:, None])
        reached = (z - radii)[:, None, None] <= reach
        return np.any(reached & down[:, :, None] & across[:, None, :], axis=(1, 2))


def _parts_of(
    x: Float64, z: Float64, radii: Float64, focal: float, centre: float, size: int, parts: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and last of ``parts`` of ``size`` pixels that may show balls, along one axis."""
    near, far = z - radii, z + radii
    everywhere = near < NEAR
    near = np.maximum(near, NEAR)
    low, high = x - radii, x + radii
    begin = focal * low / np.where(low < 0.0, near, np.maximum(far, NEAR)) + centre
    end = focal * high / np.where(high > 0.0, near, np.maximum(far, NEAR)) + centre
    begins = _edges(size, parts)
    first = np.searchsorted(begins, np.where(everywhere, 0.0, np.floor(begin)), side="right") - 1
    last = np.searchsorted(begins, np.where(everywhere, size, np.ceil(end)), side="right") - 1
    return np.maximum(first, 0), np.maximum(last, 0)
