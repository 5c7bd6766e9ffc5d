# SPDX-License-Identifier: Apache-2.0
"""Boxes around an object's Gaussians: along the world's axes, and along its own.

Both are of an object's main parts (:func:`main_parts`) and trimmed: a stray Gaussian, such as one of
the wall that a ragged mask gave to the lamp before it, must not decide a box. A side ends where the Gaussians
there become half transparent (:class:`Extents`), beyond their centres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.types import Float64

Vector = tuple[float, float, float]

_TRIM = 1.0  # percent at either end of an axis
_LINK = 3.0  # median distances to the nearest neighbour: closer points are one part
_LEAST_PART = 0.02  # of the points, and three of them; a smaller part is stray
_ALWAYS = 0.25  # of the points: a part that has so many counts wherever it is
_FACE = 0.05  # of the points: so many, the outermost, make a face; three at least
_POINTS = 4000  # points a hull is made of at most


@dataclass(frozen=True)
class Box:
    """A box along the world's axes: its ``low`` and ``high`` corners, metres."""

    low: Vector
    high: Vector


@dataclass(frozen=True)
class OrientedBox:
    """A box along an object's own axes, the longest first.

    Attributes:
        centre: its middle, metres, world frame.
        quat: rotation from the box's axes to the world's, w first.
        half_sizes: metres, falling.
        sigmas: standard deviations of the three whole sides, metres: the Gaussians' at both faces, by which
            the map blurs where the object ends; None: not known. What no view saw they do not tell.
    """

    centre: Vector
    quat: tuple[float, float, float, float]
    half_sizes: Vector
    sigmas: Vector | None = None

    @property
    def axes(self) -> Float64:
        """[3, 3] the box's axes in the world frame, as columns."""
        return se3.matrix_from_quat(self.quat)


@dataclass(frozen=True)
class Extents:
    """How far Gaussians reach about their centres.

    Attributes:
        spreads: [n, 3, 3] their standard deviations, metres, along their own axes, as columns.
        reaches: [n] how many of these they go until they are half transparent, seen alone: where
            o exp(-r^2 / 2) = 1/2 for the opacity o, and 0 where that is under 1/2.
    """

    spreads: Float64
    reaches: Float64

    @classmethod
    def of(
        cls,
        quats: NDArray[np.floating],
        log_scales: NDArray[np.floating],
        opacity_logits: NDArray[np.floating],
    ) -> Extents:
        """Return those of Gaussians: [n, 4] rotations, w first, [n, 3] and [n] as the map has them."""
        lengths = np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
        w, x, y, z = (quats / lengths).astype(np.float64).T
        rotations = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        spreads = rotations.transpose(2, 0, 1) * np.exp(log_scales.astype(np.float64))[:, None, :]
        opacities = 1.0 / (1.0 + np.exp(-opacity_logits.astype(np.float64)))
        return cls(spreads, np.sqrt(2.0 * np.log(np.maximum(2.0 * opacities, 1.0))))

    def take(self, rows: NDArray[np.bool_] | NDArray[np.integer[Any]]) -> Extents:
        """Return those of ``rows``."""
        return Extents(self.spreads[rows], self.reaches[rows])

    def along(self, axes: Float64) -> Float64:
        """Return [n, 3] standard deviations along ``axes`` [3, 3], columns of length 1, metres."""
        return np.linalg.norm(np.swapaxes(self.spreads, 1, 2) @ axes, axis=1)


def main_parts(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return [n] which of ``points`` [n, 3] lie in a large enough part of their cloud.

    Points closer than three median neighbour distances are one part; a part counts with at least a
    fiftieth of the points and three of them, and the largest always does. One with less than a quarter of the
    points counts only where it is no farther from the others than they are large: three of sixteen Gaussians
    may be a handle, but not half a metre from a mouse.
    """
    return separate_parts(points) >= 0


def separate_parts(points: NDArray[np.floating]) -> NDArray[np.int32]:
    """Return [n] which large enough part of their cloud ``points`` [n, 3] lie in, the largest 0; -1: in none.

    See :func:`main_parts`.
    """
    if len(points) < 4:
        return np.zeros(len(points), np.int32)
    from scipy.spatial import KDTree  # heavy, and only needed once a map is described

    tree: Any = KDTree(points)
    nearest = tree.query(points, k=2)[0][:, 1]
    parts = linked_parts(tree, max(_LINK * float(np.median(nearest)), 1e-6))
    sizes = np.bincount(parts)
    number = np.empty(len(sizes), np.int32)
    number[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    number[sizes < min(max(_LEAST_PART * len(points), 3), sizes.max())] = -1
    number[_far_off(points, number[parts], sizes, number)] = -1
    return number[parts]


def _far_off(
    points: NDArray[np.floating], part: NDArray[np.int32], sizes: NDArray[np.intp], number: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return which parts are small, and farther from the others than these are large.

    Args:
        part: [n] the number of each point's part, -1: none.
        sizes, number: [parts] how many points each part has, and its number.
    """
    from scipy.spatial import KDTree

    large = number[sizes >= _ALWAYS * len(points)]
    joined = np.isin(part, np.append(large[large >= 0], 0))
    waiting = set(np.unique(part[~joined & (part >= 0)]).tolist())
    while waiting:
        reach = float(np.linalg.norm(np.ptp(points[joined], axis=0)))
        tree: Any = KDTree(points[joined])
        near = {k for k in waiting if tree.query(points[part == k])[0].min() <= reach}
        if not near:
            break
        joined |= np.isin(part, list(near))
        waiting -= near
    return np.isin(number, list(waiting))


def linked_parts(tree: Any, link: float) -> NDArray[np.int32]:
    """Return [n] the part, from 0 on, of each point of a ``scipy.spatial.KDTree``.

    Points within ``link`` of each other are of one part.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = tree.query_pairs(link, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(tree.n, tree.n))
    return np.asarray(connected_components(links, directed=False)[1], np.int32)


def axis_aligned_box(points: NDArray[np.floating], extents: Extents | None = None) -> Box:
    """Return the box between the 1st and 99th percentile of ``points`` [n, 3], n > 0, on each axis.

    Args:
        extents: of the Gaussians at the points, which count with them; None: points are points.
    """
    low, high, _ = _measured(np.asarray(points, np.float64), np.eye(3), extents)
    return Box(_vector(low), _vector(high))


def oriented_box(points: NDArray[np.floating], extents: Extents | None = None) -> OrientedBox:
    """Return the smallest box found around ``points`` [n, 3], n > 0, metres, and around their ``extents``.

    One side lies flush with a face of the points' convex hull, and the box is the smallest rectangle
    round their shadow on it; no direction is taken for gravity's. Sides are trimmed like
    :func:`axis_aligned_box`'s. Points on a line or fewer than four have their principal axes.
    """
    points = np.asarray(points, np.float64)
    principal = _principal_axes(points)
    core = _trimmed(points, principal)
    flush = _flush_axes(core)
    axes = principal if flush is None else flush
    low, high, sigmas = _measured(points, axes, extents)
    half, centre = np.maximum(0.5 * (high - low), 1e-6), axes @ (0.5 * (high + low))
    order = np.argsort(-half, kind="stable")
    axes, half = axes[:, order], half[order]
    # An axis has no sign of its own: fix it, so that the same points give the same box.
    axes = axes * np.where(axes[np.abs(axes).argmax(0), range(3)] < 0.0, -1.0, 1.0)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    w, x, y, z = se3.quat_from_matrix(axes).tolist()
    known = None if sigmas is None else _vector(sigmas[order])
    return OrientedBox(_vector(centre), (w, x, y, z), _vector(half), known)


def _vector(values: NDArray[np.floating]) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _principal_axes(points: Float64) -> Float64:
    if len(points) < 2:
        return np.eye(3)
    return np.linalg.eigh(np.cov(points, rowvar=False))[1]


def _measured(
    points: Float64, axes: Float64, extents: Extents | None
) -> tuple[Float64, Float64, Float64 | None]:
    """Return where the trimmed box along ``axes`` begins and ends, and the sides' standard deviations."""
    local = points @ axes
    if extents is None:
        low, high = np.percentile(local, [_TRIM, 100.0 - _TRIM], axis=0)
        return low, high, None
    spreads = extents.along(axes)
    begin, end = local - extents.reaches[:, None] * spreads, local + extents.reaches[:, None] * spreads
    low, high = np.percentile(begin, _TRIM, axis=0), np.percentile(end, 100.0 - _TRIM, axis=0)
    outermost = min(len(points), max(3, int(_FACE * len(points))))
    faces = [np.argsort(order, axis=0)[:outermost] for order in (begin, -end)]
    variances = [(np.take_along_axis(spreads, face, axis=0) ** 2).mean(axis=0) for face in faces]
    return low, high, np.sqrt(variances[0] + variances[1])


def _trimmed(points: Float64, axes: Float64) -> Float64:
    local = points @ axes
    low, high = np.percentile(local, [_TRIM, 100.0 - _TRIM], axis=0)
    core = points[((local >= low) & (local <= high)).all(axis=1)]
    return core[:: -(-len(core) // _POINTS)] if len(core) else core


def _flush_axes(points: Float64) -> Float64 | None:
    """Return the axes of the smallest box with a side flush with a face of the hull of ``points``.

    None where the points lie on a plane or there are too few.
    """
    from scipy.spatial import ConvexHull, QhullError  # heavy, and only needed once a map is described

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    normals = hull.equations[:, :3]
    normals = np.unique(np.round(normals * np.where(normals[:, :1] < 0.0, -1.0, 1.0), 2), axis=0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    frames = np.stack([across, np.cross(normals, across), normals], axis=2)
    local = (points[hull.vertices] - points[hull.vertices[0]]) @ frames
    # In millimetres, as OpenCV rounds small rectangles.
    shadows = (1000.0 * local[:, :, :2]).astype(np.float32)
    rectangles = [cv2.minAreaRect(shadow) for shadow in shadows]
    areas = np.array([w * h for _, (w, h), _ in rectangles])
    best = int((areas * np.ptp(local[:, :, 2], axis=1)).argmin())
    return frames[best] @ se3.so3_exp([0.0, 0.0, np.radians(rectangles[best][2])])
