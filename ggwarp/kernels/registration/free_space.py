# SPDX-License-Identifier: Apache-2.0
"""What views say of each other's points: that they see through them, or that they find them in place.

A view sees through a point where its depth lies behind it, at the pixel and its neighbours: nothing was there
when it was taken.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.raster.project import NEAR
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

IN_PLACE, THROUGH = 1, 2
"""What a view says of a point; 0: nothing."""

_IN_PLACE, _THROUGH = wp.constant(wp.uint8(IN_PLACE)), wp.constant(wp.uint8(THROUGH))


@wp.kernel
def _votes_kernel(
    offset: int,
    pairs: wp.array2d[wp.int32],
    motions: wp.array3d[wp.float32],
    camera: CameraIntrinsics,
    stride: int,
    tolerance: float,
    depth: wp.array3d[wp.float32],
    nearest: wp.array3d[wp.float32],
    said: wp.array3d[wp.uint8],
):
    item = offset + wp.tid()
    columns = depth.shape[2]
    pixels = depth.shape[1] * columns
    pair = item / pixels
    pixel = item - pair * pixels
    row = pixel / columns
    column = pixel - row * columns
    subject, witness = pairs[pair, 0], pairs[pair, 1]
    word = wp.uint8(0)
    z = depth[subject, row, column]
    if z > 0.0:
        u = (float(column * stride) - camera.cx) / camera.fx
        v = (float(row * stride) - camera.cy) / camera.fy
        x = wp.vec4(u * z, v * z, z, 1.0)
        p = wp.vec3()
        for k in range(3):
            for m in range(4):
                p[k] += motions[pair, k, m] * x[m]
        if p[2] > NEAR:
            # The pixel that shows it; halves to even, as NumPy has it.
            there = wp.rint(camera.fx * p[0] / p[2] + camera.cx)
            down = wp.rint(camera.fy * p[1] / p[2] + camera.cy)
            inside = there >= 0.0 and down >= 0.0
            inside = inside and there < float(camera.width) and down < float(camera.height)
            if inside:
                i = int(down) / stride
                j = int(there) / stride
                if nearest[witness, i, j] > p[2] * (1.0 + tolerance):
                    word = _THROUGH
                elif wp.abs(depth[witness, i, j] - p[2]) < tolerance * p[2]:
                    word = _IN_PLACE
    said[pair, row, column] = word


def cast_votes(
    depth: Any,
    nearest: Any,
    pairs: Any,
    motions: Any,
    camera: CameraIntrinsics,
    *,
    stride: int,
    tolerance: float,
    said: Any,
    device: Any,
) -> None:
    """Let views look at each other's points.

    Args:
        depth: [v, h, w] metres of each view at every ``stride``-th pixel of ``camera``; 0 = none.
        nearest: [v, h, w] the least of each pixel's and its neighbours'; 0 where one of them has none.
        pairs: [p, 2] int views: whose points are looked at, and who looks.
        motions: [p, 4, 4] from the first's camera frame to the second's.
        tolerance: surfaces whose depths differ by less than this share may be one.
        said: [p, h, w] uint8, written: :data:`THROUGH`, :data:`IN_PLACE` or 0.
    """
    launch_split(
        _votes_kernel,
        said.size,
        inputs=[pairs, motions, camera, stride, tolerance, depth, nearest],
        outputs=[said],
        device=device,
        min_piece=4096,
    )
