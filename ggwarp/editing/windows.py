# SPDX-License-Identifier: Apache-2.0
"""The part of a picture that some Gaussians, or some pixels, take up: what of it need be rendered."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.camera import NEAR, Camera
from ggwarp.kernels.raster.project import LOW_PASS, MAX_REACH, TILE, Window
from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float64

Bools = NDArray[np.bool_]

_BEYOND = 1.3  # times half the view, where projection is held: ``project.frozen_slope``


def footprints(gaussians: Gaussians, camera: Camera, T_wc: Float64) -> Float64:
    """Return [n, 4] columns x0 to x1 and rows y0 to y1 that hold each Gaussian's ellipse, not cut.

    They hold it whatever its opacity and turn, as a ball of its largest scale. Those behind the camera have
    infinities the wrong way round.
    """
    x, y, z = se3.transform_points(se3.inverse(T_wc), gaussians.means).T
    front = z >= NEAR
    z = np.where(front, z, 1.0)
    sides = (0.5 * camera.width, camera.fx, camera.cx), (0.5 * camera.height, camera.fy, camera.cy)
    spread = np.zeros(len(z))
    for slope, (half, focal, centre) in zip((x / z, y / z), sides, strict=True):
        farthest = (_BEYOND * half + abs(half - 0.5 - centre)) / focal
        spread += (focal / z) ** 2 * (1.0 + np.minimum(np.abs(slope), farthest) ** 2)
    largest = np.exp(2.0 * gaussians.log_scales.max(axis=1).astype(np.float64))
    reach = np.where(front, np.sqrt(float(MAX_REACH) * (largest * spread + float(LOW_PASS))), -np.inf)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return np.stack([u - reach, v - reach, u + reach, v + reach], axis=1)


def touching(footprint: Float64, window: Window) -> Bools:
    """Return [n] which of the ``footprint`` rows [n, 4] reach into ``window``."""
    x0, y0, x1, y1 = window
    left, top, right, bottom = footprint.T
    across, along = (left < x1) & (right >= x0), (top < y1) & (bottom >= y0)
    return np.asarray(across & along & (left <= right) & (top <= bottom), bool)


def window_round(footprint: Float64, camera: Camera, *, margin: int = 0) -> Window | None:
    """Return the tiles that hold what the image shows of ``footprint`` [n, 4]; None: nothing.

    Args:
        margin: pixels that the window is wider on each side.
    """
    shown = footprint[touching(footprint, (0, 0, camera.width, camera.height))]
    if not len(shown):
        return None
    (left, top), (right, bottom) = shown[:, :2].min(axis=0), shown[:, 2:].max(axis=0)
    return _whole_tiles(left, top, right, bottom, camera, margin)


def window_of(pixels: Bools, camera: Camera) -> Window | None:
    """Return the tiles that hold the ``pixels`` [h, w]; None: there are none."""
    if not pixels.any():
        return None
    rows, columns = np.nonzero(pixels.any(axis=1))[0], np.nonzero(pixels.any(axis=0))[0]
    return _whole_tiles(columns[0], rows[0], columns[-1], rows[-1], camera, 0)


def _whole_tiles(x0: float, y0: float, x1: float, y1: float, camera: Camera, margin: int) -> Window:
    """Return the tiles of the image that hold the pixels from (x0, y0) to (x1, y1), both included."""
    tile = int(TILE)

    def span(low: float, high: float, size: int) -> tuple[int, int]:
        first = int(np.clip(np.floor(low) - margin, 0, size - 1))
        last = int(np.clip(np.ceil(high) + margin, 0, size - 1))
        return first // tile * tile, min((last // tile + 1) * tile, size)

    (left, right), (top, bottom) = span(x0, x1, camera.width), span(y0, y1, camera.height)
    return left, top, right, bottom
