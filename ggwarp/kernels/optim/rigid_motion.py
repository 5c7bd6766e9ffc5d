# SPDX-License-Identifier: Apache-2.0
"""Gaussians moved, and scaled where the world has no scale of its own, with what Adam remembers of them.

Gradients by a position turn with it, and so do those by a quaternion when that is multiplied from the left:
both maps are orthogonal. Adam's first moments are means of gradients and turn exactly. Its second moments are
means of squares, component by component: they are taken on as if components were uncorrelated. Where lengths
grow by s, gradients by a position shrink by it, and those by a log scale stay.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.math import matrix_to_quat, rotation_of, transform_point, vec16
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})


@wp.func
def _product_matrix(q: wp.vec4) -> wp.mat44:
    """The matrix of x -> q x, quaternions w first."""
    return wp.mat44(
        q[0], -q[1], -q[2], -q[3],
        q[1], q[0], -q[3], q[2],
        q[2], q[3], q[0], -q[1],
        q[3], -q[2], q[1], q[0],
    )  # fmt: skip


@wp.kernel
def _move_kernel(
    offset: int,
    motions: wp.array[wp.mat44],
    scales: wp.array[wp.float32],
    keyframe_ids: wp.array[wp.int32],
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    first: wp.array[vec16],
    second: wp.array[vec16],
):
    i = offset + wp.tid()
    T = motions[keyframe_ids[i]]
    s = scales[keyframe_ids[i]]
    R = rotation_of(T)
    Q = _product_matrix(matrix_to_quat(R))
    means[i] = transform_point(T, s * means[i])
    log_scales[i] += wp.vec3(wp.log(s))
    quats[i] = wp.normalize(Q * quats[i])
    m = first[i]
    v = second[i]
    a = R * wp.vec3(m[0], m[1], m[2])
    b = Q * wp.vec4(m[3], m[4], m[5], m[6])
    c = wp.cw_mul(R, R) * wp.vec3(v[0], v[1], v[2])
    d = wp.cw_mul(Q, Q) * wp.vec4(v[3], v[4], v[5], v[6])
    for k in range(3):
        m[k] = a[k] / s
        v[k] = c[k] / (s * s)
    for k in range(4):
        m[3 + k] = b[k]
        v[3 + k] = d[k]
    first[i] = m
    second[i] = v


def move_gaussians(
    motions: Any,
    scales: Any,
    *,
    keyframe_ids: Any,
    means: Any,
    quats: Any,
    log_scales: Any,
    first: Any,
    second: Any,
    count: int,
    device: Any,
) -> None:
    """Move each Gaussian by the motion of its keyframe, in place; see :mod:`ggwarp.kernels.optim.adam`.

    Args:
        motions: [k] mat44, rigid, of the world, after it was scaled.
        scales: [k] float, by which lengths grow; 1 leaves every bit of a rigid motion.
        keyframe_ids: [>= count] int, which of them is each Gaussian's.
        means, quats, log_scales: [>= count] vec3, vec4 (unit, w first) and vec3.
        first, second: [>= count] vec16, Adam's moments.
        count: Gaussians that are moved.
    """
    launch_split(
        _move_kernel,
        count,
        inputs=[motions, scales, keyframe_ids],
        outputs=[means, quats, log_scales, first, second],
        device=device,
    )
