# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera: where points appear, and where pixels look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

NEAR = 0.05
"""Metres: nothing nearer than this is in a picture, as in the kernels."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        width, height: image size, pixels.
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels; integers are pixel centres.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same picture resampled to ``width`` x ``height``."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
        )

    def scaled(self, scale: float) -> Camera:
        """Return the camera of the same picture at ``scale`` (sizes rounded to whole pixels)."""
        return self.resized(max(1, round(self.width * scale)), max(1, round(self.height * scale)))

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[3, 3] takes points of the camera frame to pixels, times their depth."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return where points appear, inside the picture or not, and which are in front of the camera.

        Args:
            points: [..., 3] metres, camera frame.

        Returns:
            [..., 2] pixels (u, v), in the points' float type, and [...] whether the point is farther than
            :data:`NEAR`; the pixels of the others are rubbish.
        """
        x, y, z = np.moveaxis(points, -1, 0)
        front = z > NEAR
        depth = np.where(front, z, np.ones_like(z))
        return np.stack([x / depth * self.fx + self.cx, y / depth * self.fy + self.cy], axis=-1), front

    def pixels_of(self, points: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        """Return the rows and columns of the pixels that show points [..., 3], and which the picture shows.

        Row and column are 0 where it does not.
        """
        pixels, front = self.project(points)
        columns, rows = np.moveaxis(np.rint(pixels), -1, 0)
        inside = front & (rows >= 0) & (rows < self.height) & (columns >= 0) & (columns < self.width)
        rows, columns = (np.where(inside, at, np.zeros_like(at)).astype(np.intp) for at in (rows, columns))
        return rows, columns, inside

    def rays(self, u: ArrayLike, v: ArrayLike) -> NDArray[Any]:
        """Return [..., 3] where pixels look: camera frame, 1 along the optical axis.

        Args:
            u, v: columns and rows, whole or not; they are broadcast.
        """
        x, y = np.broadcast_arrays((np.asarray(u) - self.cx) / self.fx, (np.asarray(v) - self.cy) / self.fy)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def back_project(self, u: ArrayLike, v: ArrayLike, depth: ArrayLike) -> NDArray[Any]:
        """Return [..., 3] the points at ``depth`` metres (along the optical axis) that pixels show."""
        return self.rays(u, v) * np.asarray(depth)[..., None]
