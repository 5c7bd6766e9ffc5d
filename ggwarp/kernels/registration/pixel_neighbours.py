# SPDX-License-Identifier: Apache-2.0
"""Neighbours among the points of a depth image: the exact k nearest, and what their normals differ by.

A point whose pixel lies ``r`` samples away is at least as far as the planes through the camera centre and
the sample columns and rows at that distance. The search grows ring by ring of samples round the query's
own and ends when those planes are farther than the k-th best: mostly after 25 samples.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

MOST_NEIGHBOURS = 16
"""The k best are kept in registers: so many at most."""

_vec_d2 = wp.types.vector(MOST_NEIGHBOURS, wp.float32)
_vec_index = wp.types.vector(MOST_NEIGHBOURS, wp.int32)


@wp.kernel
def _place(pixels: wp.array[wp.vec2i], stride: int, places: wp.array2d[int]):
    i = wp.tid()
    places[pixels[i][1] // stride, pixels[i][0] // stride] = i


@wp.func
def _least_distance(p: wp.vec3, u: float, v: float, gap: float, intrinsics: wp.vec4) -> float:
    """At most the distance from ``p``, seen at (u, v), to any point ``gap`` pixels or more away in u or v."""
    across = (wp.abs(u - intrinsics[2]) + gap) / intrinsics[0]
    down = (wp.abs(v - intrinsics[3]) + gap) / intrinsics[1]
    nearest = wp.min(
        1.0 / (intrinsics[0] * wp.sqrt(1.0 + across * across)),
        1.0 / (intrinsics[1] * wp.sqrt(1.0 + down * down)),
    )
    # A little less: the points' coordinates are rounded.
    return 0.9999 * p[2] * gap * nearest


@wp.kernel
def _k_nearest(
    offset: int,
    points: wp.array[wp.vec3],
    pixels: wp.array[wp.vec2i],
    places: wp.array2d[int],
    stride: int,
    intrinsics: wp.vec4,
    k: int,
    indices: wp.array2d[int],
):
    i = offset + wp.tid()
    p = points[i]
    u = pixels[i][0]
    v = pixels[i][1]
    column = u // stride
    row = v // stride
    rows = places.shape[0]
    columns = places.shape[1]
    best_d2 = _vec_d2()
    best = _vec_index()
    for s in range(k):
        best_d2[s] = wp.inf
        best[s] = -1
    farthest = float(wp.inf)
    rings = wp.max(wp.max(row, rows - 1 - row), wp.max(column, columns - 1 - column))
    for ring in range(rings + 1):
        if ring > 1:
            gap = float(ring * stride)
            least = _least_distance(p, float(u), float(v), gap, intrinsics)
            if least * least > farthest:
                break
        for y in range(wp.max(row - ring, 0), wp.min(row + ring, rows - 1) + 1):
            step = int(1)
            if y != row - ring and y != row + ring:
                step = wp.max(2 * ring, 1)
            for x in range(column - ring, column + ring + 1, step):
                if x >= 0 and x < columns:
                    j = places[y, x]
                    if j >= 0:
                        d2 = wp.length_sq(points[j] - p)
                        # Of equally near points the one given first wins.
                        if d2 < farthest or (d2 == farthest and j < best[k - 1]):
                            s = int(k - 1)
                            while s > 0 and (
                                d2 < best_d2[s - 1] or (d2 == best_d2[s - 1] and j < best[s - 1])
                            ):
                                best_d2[s] = best_d2[s - 1]
                                best[s] = best[s - 1]
                                s -= 1
                            best_d2[s] = d2
                            best[s] = j
                            farthest = best_d2[k - 1]
    for s in range(k):
        indices[i, s] = best[s]


def sample_grid(height: int, width: int, stride: int) -> tuple[int, int]:
    """Return (rows, columns) of every ``stride``-th pixel of an image, from pixel stride // 2 on."""
    return len(range(stride // 2, height, stride)), len(range(stride // 2, width, stride))


def find_k_nearest_pixels(
    points: Any,
    pixels: Any,
    intrinsics: tuple[float, float, float, float],
    *,
    stride: int,
    k: int,
    places: Any,
    indices: Any,
    device: Any,
) -> None:
    """Find each point's ``k`` nearest, nearest first: as ``k_nearest.find_k_nearest`` does.

    Args:
        points: [n] wp.vec3, camera frame, z > 0, each on the ray of its pixel.
        pixels: [n] wp.vec2i, (u, v), no two of one sample.
        intrinsics: fx, fy, cx, cy, pixels.
        stride: pixels between samples.
        k: neighbours, a point's own place among them.
        places: [rows, columns] int of :func:`sample_grid`, written: the point of each sample, -1: none.
        indices: [n, k] int, written: -1 where there are fewer points.

    Raises:
        ValueError: more neighbours than :data:`MOST_NEIGHBOURS`.
    """
    if not 1 <= k <= MOST_NEIGHBOURS:
        raise ValueError(f"k nearest: k = {k}, but it must be 1 to {MOST_NEIGHBOURS}")
    n = points.shape[0]
    places.fill_(-1)
    wp.launch(_place, dim=n, inputs=[pixels, stride], outputs=[places], device=device)
    launch_split(
        _k_nearest,
        n,
        inputs=[points, pixels, places, stride, wp.vec4(*intrinsics), k],
        outputs=[indices],
        device=device,
    )


@wp.func
def _normal(q: wp.vec4) -> wp.vec3d:
    """Last axis of the rotation ``q``, w first."""
    n = wp.normalize(wp.vec4d(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])))
    one, two = wp.float64(1.0), wp.float64(2.0)
    return wp.vec3d(
        two * (n[1] * n[3] + n[0] * n[2]),
        two * (n[2] * n[3] - n[0] * n[1]),
        one - two * (n[1] * n[1] + n[2] * n[2]),
    )


@wp.kernel
def _tilts(
    offset: int,
    points: wp.array[wp.vec3],
    pixels: wp.array[wp.vec2i],
    places: wp.array2d[int],
    stride: int,
    apart: int,
    same_surface: float,
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    deviations: wp.array[float],
    neighbours: int,
    tilts: wp.array[wp.float64],
):
    i = offset + wp.tid()
    tilt = wp.float64(-1.0)
    row = pixels[i][1] // stride
    column = pixels[i][0] // stride + apart
    if column < places.shape[1]:
        j = places[row, column]
        if j >= 0:
            z = points[i][2]
            if wp.abs(z - points[j][2]) < same_surface * z:
                # In double: of a small angle single precision's cosine keeps nothing.
                cosine = wp.abs(wp.dot(_normal(quats[i]), _normal(quats[j])))
                angle = wp.acos(wp.min(cosine, wp.float64(1.0)))
                extent = wp.float64(wp.max(wp.sqrt(scales[i][0] * scales[i][1]), 1.0e-6))
                tilt = angle / (wp.float64(deviations[i]) / (wp.sqrt(wp.float64(neighbours)) * extent))
    tilts[i] = tilt


def normal_tilts(
    points: Any,
    pixels: Any,
    places: Any,
    *,
    stride: int,
    apart: int,
    same_surface: float,
    quats: Any,
    scales: Any,
    deviations: Any,
    neighbours: int,
    tilts: Any,
    device: Any,
) -> None:
    """Measure the angle between each point's normal and that of a sample beside it.

    A plane through k readings of deviation s, spread over e, is tilted by s / (sqrt(k) e) about either axis.

    Args:
        points, pixels, places, stride: as :func:`find_k_nearest_pixels` takes and leaves them.
        apart: samples to the one beside.
        same_surface: readings farther apart than this share of their depth are on two surfaces.
        quats: [n] wp.vec4, w first, ellipses whose last axis is the normal.
        scales: [n] wp.vec3, metres, their standard deviations, falling.
        deviations: [n] float, metres, of each reading, s.
        neighbours: readings that an ellipse is fitted to, k.
        tilts: [n] float64, written: in such deviations; -1 where there is none beside on the same surface.
    """
    launch_split(
        _tilts,
        points.shape[0],
        inputs=[
            points,
            pixels,
            places,
            stride,
            apart,
            same_surface,
            quats,
            scales,
            deviations,
            neighbours,
        ],
        outputs=[tilts],
        device=device,
        min_piece=1024,
    )
