# SPDX-License-Identifier: Apache-2.0
"""Space as voxels, each with a key: where things are, roughly."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.distinct import counted, ranked
from ggwarp.types import Float64

_BITS = 20  # of a voxel's key along each axis
_OFFSET = 1 << (_BITS - 1)
_SHORT = 1 << 31  # numbers below fit in 32 bits


def voxel_keys(points: Float64, size: float) -> NDArray[np.int64]:
    """Return [k] the key of the voxel of ``size`` metres that each of ``points`` [k, 3], metres, lies in.

    Points half a million voxels away and farther share the keys of nearer ones.
    """
    return _keys(np.floor(points / size).astype(np.int64).T)


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return [k] the keys of voxels by their places [3, k] in the grid."""
    x, y, z = (cells + _OFFSET) & (2 * _OFFSET - 1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def labelled_voxels(
    points: NDArray[np.floating], labels: NDArray[np.int32], size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Count points by their label and the voxel that they lie in.

    Args:
        points: [3, k] metres.
        labels: [k] below 2^26; points whose label is negative are left out.
        size: of a voxel, metres.

    Returns:
        [m] the label and the key (see :func:`voxel_keys`) of each pair that is there, by label and then by
        key, and how many points have it.
    """
    if not labels.size:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    numbers, voxels, keys_of = _numbered(np.floor(points * points.dtype.type(1.0 / size)))
    # Short numbers are sorted in half the time.
    kind = np.int32 if voxels * (int(labels.max()) + 1) < _SHORT else np.int64
    pairs, counts = counted(np.maximum(labels, -1).astype(kind) * kind(voxels) + numbers.astype(kind))
    known = np.searchsorted(pairs, 0)
    owners, chosen = np.divmod(pairs[known:].astype(np.int64), voxels)
    return owners, keys_of(chosen), counts[known:]


def _numbered(
    cells: NDArray[np.floating],
) -> tuple[NDArray[Any], int, Callable[[NDArray[np.int64]], NDArray[np.int64]]]:
    """Return [k] a number for each of ``cells`` [3, k], how many there are, and what gives numbers' keys.

    Numbers rise with the keys. They are those of a box round all cells, if it is no larger than a building.
    """
    low, high = cells.min(axis=1), cells.max(axis=1)
    if low.min() >= -_OFFSET and high.max() < _OFFSET:
        first = low.astype(np.int64)[:, None]
        shape = tuple((high.astype(np.int64) - first[:, 0] + 1).tolist())
        if (count := math.prod(shape)) < _SHORT:
            x, y, z = (cells - low[:, None]).astype(np.int32)
            numbers = (x * shape[1] + y) * shape[2] + z
            return numbers, count, lambda some: _keys(np.stack(np.unravel_index(some, shape)) + first)
    with np.errstate(invalid="ignore"):  # points that are nowhere
        keys, numbers = ranked(_keys(cells.astype(np.int64)))
    return numbers, len(keys), lambda some: keys[some]


def voxel_centres(keys: NDArray[np.int64], size: float) -> Float64:
    """Return [k, 3] the centres, metres, of the voxels of ``size`` metres with ``keys`` [k]."""
    axes = [(keys >> shift) & (2 * _OFFSET - 1) for shift in (2 * _BITS, _BITS, 0)]
    return size * (np.stack(axes, axis=1).astype(np.float64) - _OFFSET + 0.5)
