# SPDX-License-Identifier: Apache-2.0
"""Where Gaussians are, roughly: balls that hold them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry import se3, sim3
from ggwarp.geometry.voxels import voxel_keys
from ggwarp.runtime.state import state_value
from ggwarp.types import Float32, Float64

_EXTENT = math.sqrt(2.0 * math.log(255.0))
"""An opaque Gaussian is rendered as far as so many of its standard deviations: until its alpha is 1/255."""

_CELL = 0.5
"""Size of a cell, metres. Larger ones are in views that their Gaussians are not in, smaller ones are many."""


@state_value
@dataclass(frozen=True)
class Cells:
    """Balls, one for every cell of space with Gaussians in it, that hold these with their extent.

    Attributes:
        centres, radii: [m, 3] and [m] metres, world frame.
    """

    centres: Float64
    radii: Float64

    @classmethod
    def around(cls, means: Float32, log_scales: Float32) -> Cells:
        """Return the cells of Gaussians: [n, 3] centres and [n, 3] logarithms of standard deviations."""
        points = means.astype(np.float64)
        extent = _EXTENT * np.exp(log_scales.max(axis=1, initial=-np.inf).astype(np.float64))
        _, cell, counts = np.unique(voxel_keys(points, _CELL), return_inverse=True, return_counts=True)
        count = len(counts)
        sums = [np.bincount(cell, column, minlength=count) for column in points.T]
        centres = np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]
        radii = np.zeros(count)
        np.maximum.at(radii, cell, np.linalg.norm(points - centres[cell], axis=1) + extent)
        return cls(centres, radii)

    def distance(self, point: Float64) -> float:
        """Return how far the nearest ball is from ``point`` [3], metres."""
        return float((np.linalg.norm(self.centres - point, axis=1) - self.radii).min(initial=math.inf))

    @classmethod
    def at(cls, place: Float64) -> Cells:
        """Return the cell of a single point [3]."""
        return cls(place[None], np.zeros(1))

    def grown(self, by: float) -> Cells:
        """Return balls with radii larger by so many metres."""
        return Cells(self.centres, self.radii + by)

    def hold(self, others: Cells) -> bool:
        """Return whether each of some other balls lies in one of these."""
        apart = np.linalg.norm(self.centres[None] - others.centres[:, None], axis=2)
        return bool((apart + others.radii[:, None] <= self.radii).any(axis=1).all())

    def moved(self, motions: Float64) -> Cells:
        """Return balls that hold the Gaussians wherever the similarities ``motions`` [k, 4, 4] take them."""
        places = np.stack([se3.transform_points(motion, self.centres) for motion in motions])
        centres, growth = places.mean(axis=0), max(sim3.split(motion)[1] for motion in motions)
        apart = np.linalg.norm(places - centres, axis=2).max(axis=0)
        return Cells(centres, growth * self.radii + apart)


def nearest(points: Float32, places: list[Float64]) -> NDArray[np.int32]:
    """Return [n] which of ``places`` [3] is nearest to each of ``points`` [n, 3]."""
    found, least = np.zeros(len(points), np.int32), np.full(len(points), np.inf)
    for number, place in enumerate(places):
        distances2 = ((points - place) ** 2).sum(axis=1)
        nearer = distances2 < least
        found[nearer], least[nearer] = number, distances2[nearer]
    return found
