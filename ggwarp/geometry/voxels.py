# SPDX-License-Identifier: Apache-2.0
"""Space as cubic cells, each with a number: where things are, roughly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float64

_BITS = 20  # of a cell's number along each axis
_OFFSET = 1 << (_BITS - 1)


def voxel_keys(points: Float64, size: float) -> NDArray[np.int64]:
    """Return [k] the number of the cell of ``size`` metres that each of ``points`` [k, 3], metres, lies in.

    Points half a million cells away and farther share the numbers of nearer ones.
    """
    x, y, z = (np.floor(points / size).astype(np.int64) + _OFFSET).T & (2 * _OFFSET - 1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def voxel_centres(numbers: NDArray[np.int64], size: float) -> Float64:
    """Return [k, 3] the middles, metres, of the cells of ``size`` metres with ``numbers`` [k]."""
    axes = [(numbers >> shift) & (2 * _OFFSET - 1) for shift in (2 * _BITS, _BITS, 0)]
    return size * (np.stack(axes, axis=1).astype(np.float64) - _OFFSET + 0.5)
