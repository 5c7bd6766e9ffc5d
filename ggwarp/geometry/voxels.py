# SPDX-License-Identifier: Apache-2.0
"""Space as voxels, each with a key: where things are, roughly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.distinct import ranked
from ggwarp.types import Float64

_BITS = 20  # of a voxel's key along each axis
_OFFSET = 1 << (_BITS - 1)


def voxel_keys(points: Float64, size: float) -> NDArray[np.int64]:
    """Return [k] the key of the voxel of ``size`` metres that each of ``points`` [k, 3], metres, lies in.

    Points half a million voxels away and farther share the keys of nearer ones.
    """
    return _keys(np.floor(points / size).astype(np.int64).T)


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return [k] the keys of voxels by their places [3, k] in the grid."""
    x, y, z = (cells + _OFFSET) & (2 * _OFFSET - 1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def ranked_voxels(points: NDArray[np.floating], size: float) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Return [m] the keys, rising, of the voxels that ``points`` [3, k] lie in, and [k] which each lies in.

    As :func:`voxel_keys` and then :func:`ggwarp.geometry.distinct.ranked`, several times as fast in a room.
    """
    cells = np.floor(points * points.dtype.type(1.0 / size)).astype(np.int64)
    if not cells.size:
        return np.zeros(0, np.int64), np.zeros(0, np.intp)
    first, last = cells.min(axis=1), cells.max(axis=1)
    if first.min() < -_OFFSET or last.max() >= _OFFSET:
        return ranked(_keys(cells))
    _, rows, columns = (last - first + 1).tolist()
    x, y, z = cells - first[:, None]
    places, ranks = ranked((x * rows + y) * columns + z)
    places, z = np.divmod(places, columns)
    x, y = np.divmod(places, rows)
    return _keys(np.stack([x, y, z]) + first[:, None]), ranks


def voxel_centres(keys: NDArray[np.int64], size: float) -> Float64:
    """Return [k, 3] the centres, metres, of the voxels of ``size`` metres with ``keys`` [k]."""
    axes = [(keys >> shift) & (2 * _OFFSET - 1) for shift in (2 * _BITS, _BITS, 0)]
    return size * (np.stack(axes, axis=1).astype(np.float64) - _OFFSET + 0.5)
