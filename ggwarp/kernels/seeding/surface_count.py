# SPDX-License-Identifier: Apache-2.0
"""How many Gaussians lie on the surface that each pixel of a depth image shows."""

from typing import Any

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import transform_point
from ggwarp.kernels.raster.project import NEAR

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _count_kernel(
    means: wp.array[wp.vec3],
    T_cw: wp.array[wp.mat44],
    camera: CameraIntrinsics,
    tolerance: float,
    depth: wp.array2d[wp.float32],
    counts: wp.array2d[wp.int32],
):
    p = transform_point(T_cw[0], means[wp.tid()])
    # False for NaN.
    if not p[2] > NEAR:
        return
    u = wp.floor(camera.fx * p[0] / p[2] + camera.cx + 0.5)
    v = wp.floor(camera.fy * p[1] / p[2] + camera.cy + 0.5)
    if not (u >= 0.0 and v >= 0.0 and u < float(camera.width) and v < float(camera.height)):
        return
    row = int(v)
    column = int(u)
    best = tolerance * p[2]
    best_row = int(-1)
    best_column = int(-1)
    # One at an edge may project beside the pixels that show its surface.
    for y in range(wp.max(row - 1, 0), wp.min(row + 2, camera.height)):
        for x in range(wp.max(column - 1, 0), wp.min(column + 2, camera.width)):
            d = depth[y, x]
            gap = wp.abs(p[2] - d)
            if d > 0.0 and gap <= best:
                best = gap
                best_row = y
                best_column = x
    if best_row >= 0:
        wp.atomic_add(counts, best_row, best_column, 1)


@wp.kernel
def _mean_kernel(
    radius: int,
    tolerance: float,
    depth: wp.array2d[wp.float32],
    counts: wp.array2d[wp.int32],
    density: wp.array2d[wp.float32],
):
    row, column = wp.tid()
    own = depth[row, column]
    number = int(0)
    area = int(0)
    if own > 0.0:
        for y in range(wp.max(row - radius, 0), wp.min(row + radius + 1, depth.shape[0])):
            for x in range(wp.max(column - radius, 0), wp.min(column + radius + 1, depth.shape[1])):
                if wp.abs(depth[y, x] - own) <= tolerance * own:
                    number += counts[y, x]
                    area += 1
    density[row, column] = float(number) / float(wp.max(area, 1))


def count_on_surface(
    means: Any,
    *,
    count: int,
    T_cw: Any,
    camera: CameraIntrinsics,
    depth: Any,
    tolerance: float,
    counts: Any,
    device: Any,
) -> None:
    """Count each Gaussian at the pixel, of the nine around its projection, whose depth is nearest to its own.

    Args:
        means: [>= count] vec3, world frame, metres.
        T_cw: [1] mat44, world to camera.
        depth: [h, w] float, metres; 0 = none.
        tolerance: those whose depth differs by more than this share of it count nowhere.
        counts: [h, w] int, written.
        device: a Warp device.
    """
    counts.zero_()
    # Not split over threads: on the CPU an atomic sum is no more than an addition.
    wp.launch(
        _count_kernel,
        dim=count,
        inputs=[means, T_cw, camera, tolerance, depth],
        outputs=[counts],
        device=device,
    )


def mean_over_surface(
    counts: Any, *, depth: Any, radius: int, tolerance: float, density: Any, device: Any
) -> None:
    """Average counts over the pixels around each that show the same surface.

    Args:
        counts: [h, w] int.
        depth: [h, w] float, metres; 0 = none.
        radius: pixels to each side.
        tolerance: it is the same where depths differ by no more than this share of the middle one's.
        density: [h, w] float, written; 0 without depth.
        device: a Warp device.
    """
    wp.launch(
        _mean_kernel,
        dim=depth.shape,
        inputs=[radius, tolerance, depth, counts],
        outputs=[density],
        device=device,
    )
