# SPDX-License-Identifier: Apache-2.0
"""Whether a camera is one that people record with."""

from __future__ import annotations

import math
from collections.abc import Iterator

from ggwarp.geometry.camera import Camera

FIELDS = (25.0, 130.0)
"""Degrees: the wider field of view of cameras that rooms are recorded with."""
_MOST_UNEQUAL = 1.15
"""fx over fy: pixels are square, but for a few sensors' per cent."""
_FARTHEST_CENTRE = 0.1
"""Of width or height: how far the centre lies from the middle, lenses being mounted over it to 3 %."""
_ALIKE = 0.05
"""Of a size: what a centre may be off when it is the middle of images of another size, or of turned ones."""


def field_of_view(camera: Camera) -> tuple[float, float]:
    """Return the horizontal and vertical field of view, degrees."""

    def angle(focal: float, centre: float, size: int) -> float:
        return math.degrees(math.atan((centre + 0.5) / focal) + math.atan((size - 0.5 - centre) / focal))

    return angle(camera.fx, camera.cx, camera.width), angle(camera.fy, camera.cy, camera.height)


def camera_doubts(camera: Camera) -> Iterator[str]:
    """Yield what is unusual about ``camera``, though it may be right."""
    widest = max(field_of_view(camera))
    if not FIELDS[0] <= widest <= FIELDS[1]:
        yield (
            f"the field of view is {widest:.0f} degrees (fx {camera.fx:g}, fy {camera.fy:g} for "
            f"{camera.width}x{camera.height}): are the focal lengths those of images of this size?"
        )
    ratio = max(camera.fx / camera.fy, camera.fy / camera.fx)
    if ratio > _MOST_UNEQUAL:
        yield (
            f"fx {camera.fx:g} and fy {camera.fy:g} differ by {100.0 * (ratio - 1.0):.0f} %: pixels are "
            "seldom that far from square; were the images resized to another shape?"
        )
    across = (camera.cx + 0.5) / camera.width - 0.5
    down = (camera.cy + 0.5) / camera.height - 0.5
    if max(abs(across), abs(down)) > _FARTHEST_CENTRE:
        yield (
            f"the centre, cx {camera.cx:g} and cy {camera.cy:g}, lies far from the middle of {camera.width}x"
            f"{camera.height} images: {_explained(camera)}?"
        )


def _explained(camera: Camera) -> str:
    """Return what the centre of ``camera``, far from the middle, would be the middle of."""
    width, height = 2.0 * camera.cx + 1.0, 2.0 * camera.cy + 1.0
    if max(abs(width / camera.height - 1.0), abs(height / camera.width - 1.0)) < _ALIKE:
        return "are cx and cy exchanged, or the images turned"
    if abs(width * camera.height / (height * camera.width) - 1.0) < _ALIKE:
        return f"are these the intrinsics of images of {width:.0f}x{height:.0f}"
    return "are these the intrinsics of images of another size, or turned"
