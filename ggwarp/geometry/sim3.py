# SPDX-License-Identifier: Apache-2.0
"""Sim(3) in NumPy float64: motions of the world that may also change its scale.

A similarity S [4, 4] takes x to s R x + t: its upper left is s R. What one camera sees has no scale of its
own, and its scale drifts; a rigid motion is the similarity of scale 1, and is left as it is to the bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm, logm

from ggwarp.geometry import se3
from ggwarp.geometry.se3 import Array

_RIGID = 1e-9
"""A scale no farther from 1 is that of a rigid motion, which rounding has spoilt."""


def similarity(T: ArrayLike, scale: float) -> Array:
    """Return the similarity [4, 4] that scales by ``scale`` first and then moves by ``T`` [4, 4]."""
    out = np.array(T, np.float64)
    out[:3, :3] *= scale
    return out


def split(S: ArrayLike) -> tuple[Array, float]:
    """Return the rigid motion [4, 4] and the scale that make up the similarity ``S`` [4, 4]."""
    S = np.asarray(S, np.float64)
    scale = float(np.cbrt(np.linalg.det(S[:3, :3])))
    if abs(scale - 1.0) < _RIGID:
        return S, 1.0
    return se3.orthonormalised(S), scale


def moved_pose(S: ArrayLike, T_wc: ArrayLike) -> Array:
    """Return the pose [4, 4] of a camera at ``T_wc`` [4, 4] that goes with the world's similarity ``S``."""
    return se3.orthonormalised(np.asarray(S, np.float64) @ np.asarray(T_wc, np.float64))


def interpolate(S_begin: ArrayLike, S_end: ArrayLike, share: float) -> Array:
    """Return the similarity [4, 4] at ``share`` of the way between two, at a constant rate."""
    begin, end = np.asarray(S_begin, np.float64), np.asarray(S_end, np.float64)
    if split(begin)[1] == split(end)[1] == 1.0:
        return se3.interpolate(begin, end, share)
    return begin @ np.real(expm(share * np.real(logm(np.linalg.solve(begin, end)))))
