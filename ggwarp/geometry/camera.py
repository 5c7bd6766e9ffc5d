# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass


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
