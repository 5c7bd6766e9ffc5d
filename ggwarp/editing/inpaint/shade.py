# SPDX-License-Identifier: Apache-2.0
"""The shade that an object casts on the surfaces round it, which goes when the object goes.

How much of the light that reaches a place comes past the object is told by geometry and by the map: rays
over the hemisphere, as dense as the cosine, bring the brightness of what they meet first. Those that meet
the object would bring that of what is behind it: of a ray that ends in a dark shelf little is lost, and what
other things shade anyway is not the object's. Where the loss is noticeable, a surface's light is continued
from where it is not, and its texture kept. It becomes brighter by no more than :func:`most_gain`, so that the
shade of all else stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.types import Float32, Float64

NOTICED = 0.05
"""Share of the light whose loss an eye notices, and twice what pictures of 8 bits err by at mid grey."""
_RAYS = 64  # from each place
_VOXELS = 32  # along the object's longest side
_STEP = 0.9  # of a voxel
_CLEAR = 1.5  # voxels: a voxel's own surface does not shade it
_REACH = 3.0  # metres round the object: what is farther brings light as all does in the mean
_SPACINGS = 4.0  # sides of a voxel in standard deviations of Gaussians, which are half their distances
_MOST_VOXELS = 160  # along a side of what is round the object
_GRAZING = 0.1  # cosine: rays that are flatter begin as far off as these
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def most_gain(lost: Float32) -> Float32:
    """Return by how much a place may become brighter at most that lost so much of its light, 0..1.

    What lights a place lies in the same shade, and may have lost as much of its own light.
    """
    return np.asarray(1.0 / np.maximum(1.0 - lost, NOTICED) ** 2, np.float32)


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

    def distances(self, points: Float64, rays: Float64) -> Float64:
        """Return [n, m] how far from ``points`` [n, 3] each of ``rays`` [m, 3] meets it, metres, or inf."""
        enter, leave = _through(self.low, self.size, self.full.shape, points, rays)
        enter = enter.clip(min=_CLEAR * self.size)
        out = np.full(enter.shape, np.inf)
        place, ray = np.nonzero(enter < leave)
        along = enter[place, ray]
        while len(place):
            cells = (points[place] + rays[ray] * along[:, None] - self.low) / self.size
            cells = cells.astype(np.intp).clip(0, np.array(self.full.shape) - 1)
            met = self.full[tuple(cells.T)]
            out[place[met], ray[met]] = along[met]
            along = along + _STEP * self.size
            on = ~met & (along < leave[place, ray])
            place, ray, along = place[on], ray[on], along[on]
        return out


@dataclass(frozen=True)
class Surroundings:
    """What is round an object, as voxels with brightness.

    Attributes:
        low: [3] corner of the first voxel, metres, world frame.
        size: side of a voxel, metres.
        brightness: [i, j, k] of what is there, 0..1.
        clearance: [i, j, k] voxels to the nearest that is full; 0: it is.
        mean: brightness of what rays bring that meet nothing.
    """

    low: Float64
    size: float
    brightness: Float64
    clearance: Float64
    mean: float

    @classmethod
    def of(cls, gaussians: Gaussians, points: NDArray[np.floating]) -> Surroundings:
        """Return those of ``gaussians``, a map, that are opaque and near ``points`` [n, 3], an object's."""
        from scipy.ndimage import distance_transform_edt  # heavy, and only needed here

        low, high = points.min(axis=0) - _REACH, points.max(axis=0) + _REACH
        near = ((gaussians.means > low) & (gaussians.means < high)).all(axis=1)
        near &= gaussians.opacity_logits > 0.0
        means = gaussians.means[near].astype(np.float64)
        if not len(means):
            return cls(np.asarray(low, np.float64), 1.0, np.zeros((1, 1, 1)), np.ones((1, 1, 1)), 1.0)
        shown = np.clip(0.5 + SH_C0 * gaussians.colours[near], 0.0, 1.0).mean(axis=1, dtype=np.float64)
        spread = float(np.exp(np.median(gaussians.log_scales[near], axis=1)).mean())
        size = max(_SPACINGS * spread, float(np.ptp(means, axis=0).max()) / _MOST_VOXELS)
        low = means.min(axis=0) - size
        cells = ((means - low) / size).astype(np.intp)
        shape = tuple((cells.max(axis=0) + 2).tolist())
        place = np.ravel_multi_index(tuple(cells.T), shape)
        count = np.bincount(place, minlength=int(np.prod(shape)))
        total = np.bincount(place, shown, minlength=int(np.prod(shape)))
        brightness = np.divide(total, count, out=np.zeros_like(total), where=count > 0).reshape(shape)
        clearance = np.asarray(distance_transform_edt((count == 0).reshape(shape)), np.float64)
        return cls(low, size, brightness, clearance, float(shown.mean()))

    def look(self, points: Float64, rays: Float64, begin: Float64) -> tuple[Float64, Float64]:
        """Return [n, m] how bright it is from ``points`` [n, 3] along ``rays`` [m, 3], and how far off.

        Args:
            begin: [m] from where on each ray looks, metres.
        """
        shape = self.clearance.shape
        enter, leave = _through(self.low, self.size, shape, points, rays)
        enter = np.maximum(enter, begin)
        brightness, distance = np.full(enter.shape, self.mean), np.full(enter.shape, np.inf)
        place, ray = np.nonzero(enter < leave)
        along = enter[place, ray]
        while len(place):
            at = points[place] + rays[ray] * along[:, None]
            cells = ((at - self.low) / self.size).astype(np.intp).clip(0, np.array(shape) - 1)
            clearance = self.clearance[tuple(cells.T)]
            met = clearance == 0.0
            brightness[place[met], ray[met]] = self.brightness[tuple(cells[met].T)]
            distance[place[met], ray[met]] = along[met]
            along = along + self.size * np.maximum(clearance - 1.0, _STEP)
            on = ~met & (along < leave[place, ray])
            place, ray, along = place[on], ray[on], along[on]
        return brightness, distance


@dataclass(frozen=True)
class Shade:
    """An object between what is round it and the light that comes from there."""

    occluder: Occluder
    surroundings: Surroundings

    @classmethod
    def of(cls, gaussians: Gaussians, removed: NDArray[np.bool_]) -> Shade:
        """Return that of the Gaussians ``removed`` [n] from a map on what stays."""
        points = gaussians.means[removed]
        return cls(Occluder.of(points), Surroundings.of(gaussians.take(~removed), points))

    def lost(self, points: Float64, axes: Float64) -> Float32:
        """Return [n] the share of the light that the object keeps from ``points`` [n, 3].

        Args:
            axes: [3, 3] columns: two along the surface, and its normal.
        """
        directions = _hemisphere()
        rays = directions @ axes.T
        begin = _CLEAR * self.surroundings.size / np.maximum(directions[:, 2], _GRAZING)
        brightness, farther = self.surroundings.look(points, rays, begin)
        kept_away = self.occluder.distances(points, rays) < farther
        total = np.maximum(brightness.sum(axis=1), 1e-6)
        return ((brightness * kept_away).sum(axis=1) / total).astype(np.float32)


def _through(
    low: Float64, size: float, shape: tuple[int, ...], points: Float64, rays: Float64
) -> tuple[Float64, Float64]:
    """Return [n, m] where ``rays`` [m, 3] from ``points`` [n, 3] enter and leave a grid, metres."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = ((end - points[:, None]) / rays for end in (low, low + size * np.array(shape)))
    return np.fmin(to_low, to_high).max(axis=2), np.fmax(to_low, to_high).min(axis=2)


def _hemisphere() -> Float64:
    """Return [rays, 3] directions about z, as dense as the cosine of their angle to it."""
    k = np.arange(_RAYS) + 0.5
    radius, angle = np.sqrt(k / _RAYS), k * _GOLDEN_ANGLE
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=1)
