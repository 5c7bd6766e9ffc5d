# SPDX-License-Identifier: Apache-2.0
"""From a depth image to points: back-projection of a pixel grid, without depth edges."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})


@wp.func
def back_project(u: float, v: float, z: float, intrinsics: wp.vec4) -> wp.vec3:
    """Camera point of a pixel; ``intrinsics`` = (fx, fy, cx, cy)."""
    return wp.vec3((u - intrinsics[2]) * z / intrinsics[0], (v - intrinsics[3]) * z / intrinsics[1], z)


@wp.func
def _is_reading(z: float, near: float, far: float) -> bool:
    return z >= near and z <= far


@wp.func
def _bend(depth: wp.array2d[float], v: int, u: int, dv: int, du: int, near: float, far: float) -> float:
    """Relative second difference of inverse depth across a pixel; inf at the border or beside a hole.

    Inverse depth is linear over the image of a plane, so a slanted wall does not bend.
    """
    if v - dv < 0 or u - du < 0 or v + dv >= depth.shape[0] or u + du >= depth.shape[1]:
        return wp.inf
    a = depth[v - dv, u - du]
    b = depth[v + dv, u + du]
    if not (_is_reading(a, near, far) and _is_reading(b, near, far)):
        return wp.inf
    z = depth[v, u]
    return wp.abs(z / a + z / b - 2.0)


@wp.kernel
def _flag_samples(
    offset: int,
    depth: wp.array2d[float],
    columns: int,
    stride: int,
    near: float,
    far: float,
    edge: float,
    flags: wp.array[int],
):
    i = offset + wp.tid()
    v = (i // columns) * stride + stride // 2
    u = (i % columns) * stride + stride // 2
    flag = int(0)
    if _is_reading(depth[v, u], near, far):
        flag = 1
        if edge > 0.0:
            across = _bend(depth, v, u, 0, 1, near, far)
            down = _bend(depth, v, u, 1, 0, near, far)
            if not (across <= edge and down <= edge):
                flag = 0
    flags[i] = flag


@wp.kernel
def _gather_samples(
    depth: wp.array2d[float],
    columns: int,
    stride: int,
    intrinsics: wp.vec4,
    flags: wp.array[int],
    slots: wp.array[int],
    points: wp.array[wp.vec3],
    pixels: wp.array[wp.vec2i],
):
    i = wp.tid()
    if flags[i] == 0:
        return
    v = (i // columns) * stride + stride // 2
    u = (i % columns) * stride + stride // 2
    slot = slots[i]
    points[slot] = back_project(float(u), float(v), depth[v, u], intrinsics)
    pixels[slot] = wp.vec2i(u, v)


def sample_grid(height: int, width: int, stride: int) -> tuple[int, int]:
    """Return (rows, columns) of the pixel grid that :func:`sample_depth` reads."""
    rows = max(0, (height - stride // 2 + stride - 1) // stride)
    columns = max(0, (width - stride // 2 + stride - 1) // stride)
    return rows, columns


def sample_depth(
    depth: Any,
    intrinsics: tuple[float, float, float, float],
    *,
    stride: int,
    near: float,
    far: float,
    edge: float,
    flags: Any,
    slots: Any,
    points: Any,
    pixels: Any,
    device: Any,
) -> None:
    """Back-project every ``stride``-th row and column, keeping the readings that can be trusted.

    Args:
        depth: [h, w] float, metres; 0, NaN and inf are no reading.
        intrinsics: fx, fy, cx, cy, pixels.
        stride: pixels between samples; the first sample lies at stride // 2.
        near, far: readings outside are dropped, metres.
        edge: a reading is dropped when inverse depth bends across it by more than this share
            (second difference over the neighbouring pixels), or a neighbour has no reading;
            0 keeps all.
        flags, slots: [rows * columns] int, written: 1 for a kept sample, and its place among the kept:
            their last elements add up to the number of points.
        points: [rows * columns] wp.vec3, written in row order: camera frame, metres.
        pixels: [rows * columns] wp.vec2i, written: (u, v).
    """
    h, w = depth.shape
    rows, columns = sample_grid(h, w, stride)
    count = rows * columns
    if count == 0:
        return
    launch_split(
        _flag_samples,
        count,
        inputs=[depth, columns, stride, near, far, edge],
        outputs=[flags],
        device=device,
        min_piece=8192,
    )
    wp.utils.array_scan(flags, slots, inclusive=False)
    wp.launch(
        _gather_samples,
        dim=count,
        inputs=[depth, columns, stride, wp.vec4(*intrinsics), flags, slots],
        outputs=[points, pixels],
        device=device,
    )
