# SPDX-License-Identifier: Apache-2.0
"""Slow float64 reference of the ray-caster's primitives (NumPy)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.kernels.scene.primitives import BOX, FRUSTUM, RECTANGLE, SPHERE

Array = NDArray[np.float64]


def _box(o: Array, d: Array) -> list[tuple[float, Array]]:
    """Crossings of each of the six faces' planes, kept where they lie on the face."""
    hits = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            if d[axis] == 0.0:
                continue
            t = (side - o[axis]) / d[axis]
            others = np.delete(o + t * d, axis)
            if np.all(np.abs(others) <= 1.0):
                hits.append((t, side * np.eye(3)[axis]))
    return hits


def _roots(a: float, b: float, c: float) -> list[float]:
    """Real roots of a t^2 + b t + c."""
    if a == 0.0:
        return [] if b == 0.0 else [-c / b]
    roots = np.roots([a, b, c])
    return [float(r.real) for r in roots if abs(r.imag) < 1e-12]


def _sphere(o: Array, d: Array) -> list[tuple[float, Array]]:
    return [(t, o + t * d) for t in _roots(float(d @ d), 2.0 * float(o @ d), float(o @ o) - 1.0)]


def _frustum(o: Array, d: Array, taper: float) -> list[tuple[float, Array]]:
    hits = []
    slope, middle = 0.5 * (taper - 1.0), 0.5 * (taper + 1.0)
    r, dr = middle + slope * o[2], slope * d[2]
    for t in _roots(
        float(d[:2] @ d[:2] - dr**2), 2.0 * float(o[:2] @ d[:2] - r * dr), float(o[:2] @ o[:2] - r**2)
    ):
        p = o + t * d
        radius = middle + slope * p[2]
        if abs(p[2]) <= 1.0 and radius >= 0.0:
            hits.append((t, np.array([p[0], p[1], -slope * radius])))
    for cap, radius in ((-1.0, 1.0), (1.0, taper)):
        if d[2] != 0.0:
            t = (cap - o[2]) / d[2]
            if np.hypot(*(o + t * d)[:2]) <= radius:
                hits.append((t, np.array([0.0, 0.0, cap])))
    return hits


def _rectangle(o: Array, d: Array) -> list[tuple[float, Array]]:
    if d[2] == 0.0:
        return []
    t = -o[2] / d[2]
    p = o + t * d
    return [(t, np.array([0.0, 0.0, -np.sign(d[2])]))] if np.all(np.abs(p[:2]) <= 1.0) else []


def intersect(
    kind: int,
    centre: Array,
    rotation: Array,
    size: Array,
    taper: float,
    origin: Array,
    direction: Array,
    nearest: float,
) -> tuple[float, Array]:
    """First crossing of a primitive's surface beyond ``nearest``.

    Args:
        kind: BOX, SPHERE, FRUSTUM or RECTANGLE of :mod:`ggwarp.kernels.scene.primitives`.
        centre, size: [3] metres; ``size`` half extents.
        rotation: [3, 3] world from local.
        taper: a frustum's top radius over its bottom radius.
        origin, direction: [3] of the ray, world frame.
        nearest: least ray parameter.

    Returns:
        The ray parameter (inf: none) and the unit outward normal [3], world frame.
    """
    o = rotation.T @ (origin - centre) / size
    d = rotation.T @ direction / size
    if not np.any(d):
        return np.inf, np.zeros(3)
    hits = {
        BOX: lambda: _box(o, d),
        SPHERE: lambda: _sphere(o, d),
        FRUSTUM: lambda: _frustum(o, d, taper),
        RECTANGLE: lambda: _rectangle(o, d),
    }[kind]()
    hits = [hit for hit in hits if hit[0] > nearest]
    if not hits:
        return np.inf, np.zeros(3)
    t, n = min(hits, key=lambda hit: hit[0])
    normal = rotation @ (n / size)
    return t, normal / np.linalg.norm(normal)
