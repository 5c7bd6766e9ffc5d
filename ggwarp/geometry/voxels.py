# SPDX-License-Identifier: Apache-2.0
"""Space as voxels, each with a key: where things are, roughly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float64

_BITS = 20  # of a voxel's key along each axis
_OFFSET = 1 << (_BITS - 1)


def voxel_keys(points: Float64, size: float) -> NDArray[np.int64]:
    """Return [k] the key of the voxel of ``size`` metres that each of ``points`` [k, 3], metres, lies in.

    Points half a million voxels away and farther share the keys of nearer ones.
    """
    x, y, z = (np.floor(points / size).astype(np.int64) + _OFFSET).T & (2 * _OFFSET - 1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def voxel_centres(keys: NDArray[np.int64], size: float) -> Float64:
    """Return [k, 3] the centres, metres, of the voxels of ``size`` metres with ``keys`` [k]."""
    axes = [(keys >> shift) & (2 * _OFFSET - 1) for shift in (2 * _BITS, _BITS, 0)]
    return size * (np.stack(axes, axis=1).astype(np.float64) - _OFFSET + 0.5)
