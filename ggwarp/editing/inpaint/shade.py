# SPDX-License-Identifier: Apache-2.0
"""The shade that an object casts on the surfaces round it, which goes when the object goes.

How much of the light that reaches a place comes past the object is told by geometry: the share of the
hemisphere over it, weighed by the cosine, that the object blocks (ambient occlusion). Where that is
noticeable, a surface's light is continued from where it is not, and its texture kept. It becomes brighter
by no more than the light that was blocked, so that the shade of all else stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float32, Float64

NOTICED = 0.05
"""Share of the light whose loss an eye notices, and twice what pictures of 8 bits err by at mid grey."""
_RAYS = 64  # from each place
_VOXELS = 32  # along the object's longest side
_STEP = 0.9  # of a voxel
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True)
class Occluder:
    """An object as voxels.

    Attributes:
        low: [3] corner of the first voxel, metres, world frame.
        size: side of a voxel, metres.
        full: [i, j, k] whether the object is there.
    """

    low: Float64
    size: float
    full: NDArray[np.bool_]

    @classmethod
    def of(cls, points: NDArray[np.floating]) -> Occluder:
        """Return what Gaussians with these centres [n, 3] (metres) block."""
        points = np.asarray(points, np.float64)
        size = max(float(np.ptp(points, axis=0).max()) / _VOXELS, 1e-3)
        low = points.min(axis=0) - size
        cells = ((points - low) / size).astype(np.intp)
        full = np.zeros(cells.max(axis=0) + 2, bool)
        full[tuple(cells.T)] = True
        return cls(low, size, full)

    def blocked(self, points: Float64, axes: Float64) -> Float32:
        """Return [n] the share of the light of an even sky that the object keeps from ``points`` [n, 3].

        Args:
            axes: [3, 3] columns: two along the surface, and its normal.
        """
        rays = _hemisphere() @ axes.T
        high = self.low + self.size * np.array(self.full.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low, to_high = ((end - points[:, None]) / rays for end in (self.low, high))
        # A voxel's own surface does not shade it.
        enter = np.fmin(to_low, to_high).max(axis=2).clip(min=1.5 * self.size)
        leave = np.fmax(to_low, to_high).min(axis=2)
        hit = np.zeros(enter.shape, bool)
        place, ray = np.nonzero(enter < leave)
        along = enter[place, ray]
        while len(place):
            cells = (points[place] + rays[ray] * along[:, None] - self.low) / self.size
            cells = cells.astype(np.intp).clip(0, np.array(self.full.shape) - 1)
            met = self.full[tuple(cells.T)]
            hit[place[met], ray[met]] = True
            along = along + _STEP * self.size
            on = ~met & (along < leave[place, ray])
            place, ray, along = place[on], ray[on], along[on]
        return hit.mean(axis=1).astype(np.float32)


def _hemisphere() -> Float64:
    """Return [rays, 3] directions about z, as dense as the cosine of their angle to it."""
    k = np.arange(_RAYS) + 0.5
    radius, angle = np.sqrt(k / _RAYS), k * _GOLDEN_ANGLE
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=1)
