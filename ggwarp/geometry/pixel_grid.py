# SPDX-License-Identifier: Apache-2.0
"""Enough of a picture's pixels to measure areas and medians by: all of a small one, a grid of a large one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera

_ENOUGH = 50_000
"""Pixels: a share of a picture is known to a quarter of a percent."""


@dataclass(frozen=True)
class PixelGrid:
    """Every ``step``-th pixel of each row and column.

    Attributes:
        camera: whose pixels those are.
        step: 1 where they are all.
    """

    camera: Camera
    step: int

    @staticmethod
    def of(camera: Camera, enough: int = _ENOUGH) -> PixelGrid:
        """Return the grid for the pictures of ``camera`` with some ``enough`` pixels, not fewer."""
        width, height = camera.width, camera.height
        step = max(1, int((height * width / enough) ** 0.5))
        first = step // 2
        few = Camera(
            len(range(first, width, step)),
            len(range(first, height, step)),
            camera.fx / step,
            camera.fy / step,
            (camera.cx - first) / step,
            (camera.cy - first) / step,
        )
        return PixelGrid(few, step)

    def thinned(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return the grid's pixels of ``image`` [h, w, ...]."""
        at = slice(self.step // 2, None, self.step)
        return np.ascontiguousarray(image[at, at])
