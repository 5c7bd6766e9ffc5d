# SPDX-License-Identifier: Apache-2.0
"""A truncated signed distance to the surface, on a grid, as the mean over depth images.

B. Curless, M. Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH 1996.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import transform_point
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

_NEAR = wp.constant(0.05)


@wp.struct
class TsdfGrid:
    """A volume of voxels, world frame.

    Attributes:
        distances: [x, y, z] mean signed distance, in truncations; positive before the surface.
        weights: [x, y, z] how many images say so.
        colours: [x, y, z] mean colour, 0..1; of images whose surface is within one truncation.
        colour_weights: [x, y, z] how many these are.
        origin: centre of voxel (0, 0, 0), metres.
        voxel: side of a voxel, metres.
        truncation: metres.
    """

    distances: wp.array3d[float]
    weights: wp.array3d[float]
    colours: wp.array3d[wp.vec3]
    colour_weights: wp.array3d[float]
    origin: wp.vec3
    voxel: float
    truncation: float


@wp.kernel
def _integrate_kernel(
    offset: int,
    low: wp.vec3i,
    size: wp.vec3i,
    camera: CameraIntrinsics,
    T_cw: wp.mat44,
    depth: wp.array2d[float],
    rgb: wp.array2d[wp.vec3],
    grid: TsdfGrid,
):
    index = offset + wp.tid()
    i = low[0] + index // (size[1] * size[2])
    j = low[1] + (index // size[2]) % size[1]
    k = low[2] + index % size[2]
    centre = grid.origin + grid.voxel * wp.vec3(float(i), float(j), float(k))
    p = transform_point(T_cw, centre)
    if p[2] < _NEAR:
        return
    column = int(wp.floor(p[0] / p[2] * camera.fx + camera.cx + 0.5))
    row = int(wp.floor(p[1] / p[2] * camera.fy + camera.cy + 0.5))
    if column < 0 or row < 0 or column >= camera.width or row >= camera.height:
        return
    d = depth[row, column]
    distance = d - p[2]
    # Far behind the surface nothing is known.
    if d <= 0.0 or distance < -grid.truncation:
        return
    w = grid.weights[i, j, k]
    grid.distances[i, j, k] = (w * grid.distances[i, j, k] + wp.min(distance / grid.truncation, 1.0)) / (
        w + 1.0
    )
    grid.weights[i, j, k] = w + 1.0
    if distance < grid.truncation:
        c = grid.colour_weights[i, j, k]
        grid.colours[i, j, k] = (c * grid.colours[i, j, k] + rgb[row, column]) / (c + 1.0)
        grid.colour_weights[i, j, k] = c + 1.0


def integrate(
    depth: wp.array[float],
    rgb: wp.array[wp.vec3],
    *,
    T_cw: Any,
    camera: CameraIntrinsics,
    low: tuple[int, int, int],
    size: tuple[int, int, int],
    grid: TsdfGrid,
    device: Any,
) -> None:
    """Add an image to the voxels ``low`` .. ``low + size`` of ``grid``.

    Args:
        depth: [h, w] metres along the optical axis; 0 = none.
        rgb: [h, w] vec3 colours, 0..1.
        T_cw: wp.mat44, world to camera.
        low, size: in voxels; what a picture can reach.
    """
    count = size[0] * size[1] * size[2]
    inputs = [wp.vec3i(*low), wp.vec3i(*size), camera, T_cw, depth, rgb, grid]
    launch_split(_integrate_kernel, count, inputs=inputs, device=device)
