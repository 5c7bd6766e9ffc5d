# SPDX-License-Identifier: Apache-2.0
"""From the screen back to Gaussians and the camera: the adjoint of :mod:`ggwarp.kernels.raster.project`.

The composite's gradients come per slot; the slots of a Gaussian are contiguous and are summed here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import warp as wp

from ggwarp.kernels.block import load4, load16, store4, store16
from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import (
    quat_to_matrix,
    quat_to_matrix_adjoint,
    rotation_of,
    transform_point,
    vec6,
    vec16,
)
from ggwarp.kernels.raster.project import (
    LOW_PASS,
    SH_C0,
    SLOPE_LOW_PASS,
    conic_of,
    depth_slope,
    exp_each,
    frozen_slope,
    jacobian_row_x,
    jacobian_row_y,
    scaled_columns,
)
from ggwarp.kernels.raster.tiles import TileArrays
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

_POSE_BLOCK = wp.constant(256)


@dataclass(frozen=True)
class SlotGradients:
    """What the composite's adjoint writes, a row per slot (see :mod:`ggwarp.kernels.raster.tiles`).

    Attributes:
        rows: [slots] vec16: of the conic and opacity (4); mean, slope (4); colour and depth (4); then the
            splat's weight summed over the tile's pixels, padding included, and zeros.
        identities: [slots] vec16; None if C is 4.
    """

    rows: wp.array
    identities: wp.array | None


@wp.func
def _colour_gradient(colour: float, gradient: float):
    if 0.5 + SH_C0 * colour < 0.0:
        return 0.0
    return SH_C0 * gradient


@wp.func
def _slope_gradient(p: float, z: float, d_row_z: float, focal: float, centre: float, size: int):
    """Gradient through the row (f / z, -f slope / z)'s second entry: (d p, d z)."""
    slope = p / z
    frozen = frozen_slope(slope, focal, centre, size)
    d_z = focal * frozen / (z * z) * d_row_z
    d_p = float(0.0)
    if frozen == slope:
        d_p = -focal / (z * z) * d_row_z
        d_z -= d_p * slope
    return d_p, d_z


@wp.kernel
def _project_adjoint(
    offset: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[float],
    colours: wp.array[wp.vec3],
    T_cw: wp.array[wp.mat44],
    camera: CameraIntrinsics,
    visible: wp.array[int],
    ranks: wp.array[int],
    slot_offsets: wp.array[int],
    counts: wp.array[int],
    slot_rows: wp.array[vec16],
    slot_identities: wp.array[vec16],
    d_means: wp.array[wp.vec3],
    d_quats: wp.array[wp.vec4],
    d_log_scales: wp.array[wp.vec3],
    d_opacity_logits: wp.array[float],
    d_colours: wp.array[wp.vec3],
    d_identities: wp.array[vec16],
    weights: wp.array[float],
    mean2d_gradient_norms: wp.array[float],
    mean2d_gradient_counts: wp.array[int],
    d_poses: wp.array[vec6],
):
    k = offset + wp.tid()
    if k >= counts[0]:
        return
    i = visible[k]
    rank = ranks[i]
    # Slots that did not fit (overflow) were never written.
    begin = wp.clamp(slot_offsets[rank], 0, slot_rows.shape[0])
    end = wp.clamp(slot_offsets[rank + 1], begin, slot_rows.shape[0])
    d_row = vec16()
    for slot in range(begin, end):
        d_row += load16(slot_rows, slot)
    d_conic = wp.vec4(d_row[0], d_row[1], d_row[2], d_row[3])
    d_uv = wp.vec2(d_row[4], d_row[5])
    d_slope = wp.vec2(d_row[6], d_row[7])
    d_head = wp.vec4(d_row[8], d_row[9], d_row[10], d_row[11])
    if weights:
        weights[i] = d_row[12]
    if mean2d_gradient_norms:
        mean2d_gradient_norms[i] += wp.length(
            wp.vec2(0.5 * float(camera.width) * d_uv[0], 0.5 * float(camera.height) * d_uv[1])
        )
        mean2d_gradient_counts[i] += 1
    if d_identities:
        d_o = vec16()
        for slot in range(begin, end):
            d_o += load16(slot_identities, slot)
        store16(d_identities, i, d_o)
    if d_means:
        colour = colours[i]
        d_colours[i] = wp.vec3(
            _colour_gradient(colour[0], d_head[0]),
            _colour_gradient(colour[1], d_head[1]),
            _colour_gradient(colour[2], d_head[2]),
        )
        opacity = 1.0 / (1.0 + wp.exp(-opacity_logits[i]))
        d_opacity_logits[i] = d_conic[3] * opacity * (1.0 - opacity)

    # Forward again: cheaper than storing it.
    p = transform_point(T_cw[0], means[i])
    R_cw = rotation_of(T_cw[0])
    quat = load4(quats, i)
    q = wp.normalize(quat)
    s = exp_each(log_scales[i])
    m = scaled_columns(R_cw * quat_to_matrix(q), s)
    j0 = jacobian_row_x(p, camera)
    j1 = jacobian_row_y(p, camera)
    w0 = wp.transpose(m) * j0
    w1 = wp.transpose(m) * j1
    jz = wp.vec3(0.0, 0.0, 1.0)
    wz = m[2]
    conic, _xx, _yy = conic_of(w0, w1, LOW_PASS)
    sharp, _xx, _yy = conic_of(w0, w1, SLOPE_LOW_PASS)

    # d covariance = -g, g = Q G Q for the conic Q and its symmetric gradient G; the slope S k with its
    # own conic S and k = (w0 . wz, w1 . wz) adds the symmetric part of (S d_slope) slope^T.
    conic2 = wp.mat22(conic[0], conic[1], conic[1], conic[2])
    d_k = wp.mat22(sharp[0], sharp[1], sharp[1], sharp[2]) * d_slope
    slope_term = wp.outer(d_k, depth_slope(w0, w1, wz))
    g = conic2 * wp.mat22(d_conic[0], 0.5 * d_conic[1], 0.5 * d_conic[1], d_conic[2]) * conic2
    g += 0.5 * (slope_term + wp.transpose(slope_term))
    d_w0 = d_k[0] * wz - 2.0 * (g[0, 0] * w0 + g[0, 1] * w1)
    d_w1 = d_k[1] * wz - 2.0 * (g[1, 0] * w0 + g[1, 1] * w1)
    d_wz = d_k[0] * w0 + d_k[1] * w1
    d_m = wp.outer(j0, d_w0) + wp.outer(j1, d_w1) + wp.outer(jz, d_wz)
    d_j0 = m * d_w0
    d_j1 = m * d_w1
    if d_means:
        d_log_scales[i] = wp.vec3(
            wp.dot(wp.transpose(m)[0], wp.transpose(d_m)[0]),
            wp.dot(wp.transpose(m)[1], wp.transpose(d_m)[1]),
            wp.dot(wp.transpose(m)[2], wp.transpose(d_m)[2]),
        )
        d_q = quat_to_matrix_adjoint(q, wp.transpose(R_cw) * scaled_columns(d_m, s))
        store4(d_quats, i, (d_q - q * wp.dot(q, d_q)) / wp.length(quat))

    z = p[2]
    d_x, d_zx = _slope_gradient(p[0], z, d_j0[2], camera.fx, camera.cx, camera.width)
    d_y, d_zy = _slope_gradient(p[1], z, d_j1[2], camera.fy, camera.cy, camera.height)
    d_x += camera.fx / z * d_uv[0]
    d_y += camera.fy / z * d_uv[1]
    d_z = d_head[3] + d_zx + d_zy
    d_z -= (camera.fx * (p[0] * d_uv[0] + d_j0[0]) + camera.fy * (p[1] * d_uv[1] + d_j1[1])) / (z * z)
    d_p = wp.vec3(d_x, d_y, d_z)
    if d_means:
        d_means[i] = wp.transpose(R_cw) * d_p
    if d_poses:
        # T_cw <- Exp(v, w) T_cw moves p by v + w x p and turns the columns of m by w.
        d_w = wp.cross(p, d_p) + wp.cross(d_j0, j0) + wp.cross(d_j1, j1) + wp.cross(m * d_wz, jz)
        d_poses[k] = vec6(d_p[0], d_p[1], d_p[2], d_w[0], d_w[1], d_w[2])


@wp.kernel
def _sum_blocks(
    values: wp.array[vec6],
    limit: wp.array[int],
    count: int,
    sums: wp.array[vec6],
):
    block = wp.tid()
    end = wp.min((block + 1) * _POSE_BLOCK, count)
    if limit:
        end = wp.min(end, limit[0])
    total = vec6()
    for k in range(block * _POSE_BLOCK, end):
        total += values[k]
    sums[block] = total


def project_adjoint(
    means: wp.array,
    quats: wp.array,
    log_scales: wp.array,
    opacity_logits: wp.array,
    colours: wp.array,
    *,
    T_cw: wp.array,
    camera: CameraIntrinsics,
    count: int,
    tiles: TileArrays,
    slots: SlotGradients,
    d_means: wp.array | None = None,
    d_quats: wp.array | None = None,
    d_log_scales: wp.array | None = None,
    d_opacity_logits: wp.array | None = None,
    d_colours: wp.array | None = None,
    d_identities: wp.array | None = None,
    weights: wp.array | None = None,
    mean2d_gradient_norms: tuple[wp.array, wp.array] | None = None,
    d_pose_scratch: tuple[wp.array, ...] = (),
) -> None:
    """Chain the composite's gradients to the visible Gaussians and, on request, to the camera.

    Rows of Gaussians that are not visible are left as they are.

    Args:
        means, quats, log_scales, opacity_logits, colours, T_cw, camera, count: as given to
            :func:`ggwarp.kernels.raster.project.project`.
        tiles: the binning that the composite used.
        slots: gradients per slot.
        d_means, d_quats, d_log_scales, d_opacity_logits, d_colours: outputs, like the parameters; all
            None: only the camera's gradient is wanted.
        d_identities: output [>= count] vec16; None skips it.
        weights: output [>= count] float, the sum of w over the view's pixels, padding included; None
            skips it.
        mean2d_gradient_norms: in and out, [>= count] float and int: the length of the projected mean's
            gradient, in an image 2 wide and 2 high, is added to the one, 1 to the other; None skips it.
        d_pose_scratch: vec6 arrays of :func:`pose_levels` lengths; the last, of one row, receives
            the gradient (translation, rotation) of T_cw <- Exp(tau) T_cw. Empty: no pose gradient.
    """
    device = means.device
    readable = device.is_cpu and not device.is_capturing
    visible = int(tiles.counts.numpy()[0]) if readable else count
    launch_split(
        _project_adjoint,
        visible,
        inputs=[
            means, quats, log_scales, opacity_logits, colours, T_cw, camera,
            tiles.visible, tiles.ranks, tiles.slot_offsets, tiles.counts,
            slots.rows, slots.identities,
        ],
        outputs=[
            d_means, d_quats, d_log_scales, d_opacity_logits, d_colours, d_identities, weights,
            *(mean2d_gradient_norms or (None, None)),
            d_pose_scratch[0] if d_pose_scratch else None,
        ],
        device=device,
    )  # fmt: skip
    limit = tiles.counts
    for values, sums in pairwise(d_pose_scratch):
        wp.launch(
            _sum_blocks,
            dim=sums.shape[0],
            inputs=[values, limit, values.shape[0]],
            outputs=[sums],
            device=device,
        )
        limit = None


def pose_levels(capacity: int) -> list[int]:
    """Return the lengths of ``d_pose_scratch`` for ``capacity`` Gaussians: block sums down to one."""
    lengths = [max(capacity, 1)]
    while len(lengths) == 1 or lengths[-1] > 1:
        lengths.append(-(-lengths[-1] // int(_POSE_BLOCK)))
    return lengths
