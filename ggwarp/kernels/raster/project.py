# SPDX-License-Identifier: Apache-2.0
"""Gaussians to the screen: EWA projection.

A Gaussian of mean p, rotation R and scale S seen by the camera ``T_cw`` becomes an ellipse with
covariance J A S S^T A^T J^T + 0.3 I (px^2), A = R_cw R, where J is the Jacobian of the pinhole at
the mean (Zwicker 2001; Kerbl 2023). Outside 1.3 times the field of view J is frozen at its edge.

A pixel sees the Gaussian at its depth given that pixel: the conditional expectation of z given (u, v),
which is a plane over the image through the mean. One depth for the whole ellipse would bend slanted surfaces
towards the camera, as the splats in front win.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.block import load4, load16, store16
from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import (
    quat_to_matrix,
    rotation_of,
    transform_point,
    vec16,
)
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(16)
NEAR = wp.constant(0.05)
LOW_PASS = wp.constant(0.3)
SLOPE_LOW_PASS = wp.constant(0.03)
LOG_ALPHA_MIN = wp.constant(-math.log(255.0))
MAX_REACH = wp.constant(2.0 * math.log(255.0) * 1.01)
SH_C0 = wp.constant(0.28209479177387814)

Window = tuple[int, int, int, int]
"""A part of an image: columns x0 to x1 and rows y0 to y1, half open, as (x0, y0, x1, y1)."""


@dataclass(frozen=True)
class Splats:
    """What projection writes, a row per Gaussian; rows of culled ones hold only ``tile_rects``.

    What compositing needs of a Gaussian, save its identity, is one vec16: a cache line.

    Attributes:
        rows: [n] vec16: the conic (a, b, c), opacity; mean, slope; colour and depth; extent, ln opacity, 0.
        depths: [n] camera z of the mean, metres.
        tile_rects: [n] vec4i (x0, y0, x1, y1) tiles, half open; x0 == x1 when culled.
    """

    rows: wp.array
    depths: wp.array
    tile_rects: wp.array

    @property
    def conics(self) -> wp.array:
        """[n] vec4 (a, b, c, opacity): alpha = opacity exp(-(a dx^2 + c dy^2) / 2 - b dx dy)."""
        return row_part(self.rows, 0, wp.vec4)

    @property
    def means2d(self) -> wp.array:
        """[n] vec2, pixels."""
        return row_part(self.rows, 4, wp.vec2)

    @property
    def slopes(self) -> wp.array:
        """[n] vec2, metres per pixel: what the depth gains away from the mean."""
        return row_part(self.rows, 6, wp.vec2)

    @property
    def heads(self) -> wp.array:
        """[n] vec4: colour (clamped at 0), depth of the mean."""
        return row_part(self.rows, 8, wp.vec4)

    @property
    def extents(self) -> wp.array:
        """[n] vec2, pixels: half width and height of where alpha reaches 1/255."""
        return row_part(self.rows, 12, wp.vec2)


def row_part(rows: wp.array, lane: int, dtype: Any) -> wp.array:
    """Return a view of the lanes from ``lane`` on of [n] vec16 ``rows``."""
    pointer = (rows.ptr or 0) + 4 * lane
    view = wp.array(ptr=pointer, dtype=dtype, shape=rows.shape, strides=(64,), device=rows.device)
    view._ref = rows
    return view


@wp.func
def frozen_slope(slope: float, focal: float, centre: float, size: int):
    """Clamp x/z to 1.3 times the view, measured from the principal point."""
    margin = 0.15 * float(size) / focal
    low = -(centre + 0.5) / focal - margin
    high = (float(size) - 0.5 - centre) / focal + margin
    return wp.clamp(slope, low, high)


@wp.func
def jacobian_row_x(p: wp.vec3, camera: CameraIntrinsics):
    slope = frozen_slope(p[0] / p[2], camera.fx, camera.cx, camera.width)
    return wp.vec3(camera.fx / p[2], 0.0, -camera.fx * slope / p[2])


@wp.func
def jacobian_row_y(p: wp.vec3, camera: CameraIntrinsics):
    slope = frozen_slope(p[1] / p[2], camera.fy, camera.cy, camera.height)
    return wp.vec3(0.0, camera.fy / p[2], -camera.fy * slope / p[2])


@wp.func
def scaled_columns(m: wp.mat33, s: wp.vec3):
    return wp.mat33(
        m[0, 0] * s[0], m[0, 1] * s[1], m[0, 2] * s[2],
        m[1, 0] * s[0], m[1, 1] * s[1], m[1, 2] * s[2],
        m[2, 0] * s[0], m[2, 1] * s[1], m[2, 2] * s[2],
    )  # fmt: skip


@wp.func
def exp_each(v: wp.vec3):
    return wp.vec3(wp.exp(v[0]), wp.exp(v[1]), wp.exp(v[2]))


@wp.func
def conic_of(w0: wp.vec3, w1: wp.vec3, low_pass: float):
    """Inverse of W W^T + low_pass I (a, b, c) for the rows of W, and that matrix's two variances."""
    p = wp.dot(w0, w0)
    q = wp.dot(w1, w1)
    # Lagrange's identity: p q - (w0 . w1)^2 without the cancellation of thin ellipses.
    n = wp.cross(w0, w1)
    inverse_det = 1.0 / (wp.dot(n, n) + low_pass * (p + q) + low_pass * low_pass)
    xx = p + low_pass
    yy = q + low_pass
    return wp.vec3(yy * inverse_det, -wp.dot(w0, w1) * inverse_det, xx * inverse_det), xx, yy


@wp.func
def depth_slope(w0: wp.vec3, w1: wp.vec3, wz: wp.vec3):
    """Slope of E[z | u, v] for the rows of W and the row of z: conic times (w0 . wz, w1 . wz).

    Its low-pass only bounds the slope of splats seen edge on: that of the picture would flatten splats
    of a pixel's size, whose neighbours continue the surface.
    """
    # Determinant and products as in conic_of: thin ellipses would cancel.
    n = wp.cross(w0, w1)
    low_pass = SLOPE_LOW_PASS
    det = wp.dot(n, n) + low_pass * (wp.dot(w0, w0) + wp.dot(w1, w1)) + low_pass * low_pass
    return (1.0 / det) * wp.vec2(
        wp.dot(n, wp.cross(wz, w1)) + low_pass * wp.dot(w0, wz),
        wp.dot(n, wp.cross(w0, wz)) + low_pass * wp.dot(w1, wz),
    )


@wp.func
def _off_screen(centre: float, reach2: float, low: int, high: int):
    beyond = wp.max(float(low) - centre, centre - float(high - 1))
    return beyond > 0.0 and beyond * beyond > reach2


@wp.func
def _tile_span(centre: float, extent: float, low: int, high: int):
    """First and last-plus-one tile with a pixel from ``low`` to ``high`` (half open) near ``centre``."""
    # Clamped before the conversion: a float outside the range of int is undefined.
    first = int(wp.clamp(wp.ceil(centre - extent), float(low), float(high)))
    last = int(wp.clamp(wp.floor(centre + extent), float(low) - 1.0, float(high - 1)))
    begin = first / TILE
    end = last / TILE + 1
    if last < first:
        end = begin
    return begin, end


@wp.kernel
def _project(
    offset: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[float],
    colours: wp.array[wp.vec3],
    identities: wp.array[vec16],
    T_cw: wp.array[wp.mat44],
    camera: CameraIntrinsics,
    window: wp.vec4i,
    rows: wp.array[vec16],
    depths: wp.array[float],
    tile_rects: wp.array[wp.vec4i],
):
    i = offset + wp.tid()
    tile_rects[i] = wp.vec4i(0, 0, 0, 0)
    p = transform_point(T_cw[0], means[i])
    # Negated comparisons so that NaN is culled.
    if not (p[2] >= NEAR):
        return
    u = camera.fx * p[0] / p[2] + camera.cx
    v = camera.fy * p[1] / p[2] + camera.cy
    row_x = jacobian_row_x(p, camera)
    row_y = jacobian_row_y(p, camera)
    # Most Gaussians of a room are off the screen: a bound on the ellipse (opacity 1, a ball of the
    # largest scale, 1 % for rounding) tells without the rest.
    largest = wp.exp(wp.max(log_scales[i]))
    bound = MAX_REACH * (largest * largest * (wp.dot(row_x, row_x) + wp.dot(row_y, row_y)) + LOW_PASS)
    if _off_screen(u, bound, window[0], window[2]) or _off_screen(v, bound, window[1], window[3]):
        return
    opacity = 1.0 / (1.0 + wp.exp(-opacity_logits[i]))
    if not (opacity * 255.0 > 1.0):
        return
    quat = load4(quats, i)
    norm2 = wp.dot(quat, quat)
    rotation = rotation_of(T_cw[0]) * quat_to_matrix(wp.normalize(quat))
    m = wp.transpose(scaled_columns(rotation, exp_each(log_scales[i])))
    w0 = m * row_x
    w1 = m * row_y
    conic, xx, yy = conic_of(w0, w1, LOW_PASS)
    slope = depth_slope(w0, w1, wp.vec3(m[0, 2], m[1, 2], m[2, 2]))
    # alpha >= 1/255 <=> the squared Mahalanobis distance is at most 2 ln(255 opacity).
    log_opacity = wp.log(opacity)
    reach = 2.0 * wp.max(log_opacity - LOG_ALPHA_MIN, 0.0)
    colour = colours[i]
    # A sum is finite only if its terms are.
    check = norm2 + u + v + conic[0] + conic[1] + conic[2] + xx + yy + slope[0] + slope[1]
    check += colour[0] + colour[1] + colour[2]
    if identities:
        o = load16(identities, i)
        check += wp.dot(o, o)
    if not (wp.isfinite(check) and norm2 > 0.0):
        return
    extent_x = wp.sqrt(reach * xx)
    extent_y = wp.sqrt(reach * yy)
    x0, x1 = _tile_span(u, extent_x, window[0], window[2])
    y0, y1 = _tile_span(v, extent_y, window[1], window[3])
    if x0 >= x1 or y0 >= y1:
        return
    tile_rects[i] = wp.vec4i(x0, y0, x1, y1)
    depths[i] = p[2]
    row = vec16(
        conic[0], conic[1], conic[2], opacity,
        u, v, slope[0], slope[1],
        wp.max(0.5 + SH_C0 * colour[0], 0.0),
        wp.max(0.5 + SH_C0 * colour[1], 0.0),
        wp.max(0.5 + SH_C0 * colour[2], 0.0),
        p[2],
        extent_x, extent_y, log_opacity, 0.0,
    )  # fmt: skip
    store16(rows, i, row)


def project(
    means: wp.array,
    quats: wp.array,
    log_scales: wp.array,
    opacity_logits: wp.array,
    colours: wp.array,
    identities: wp.array | None,
    *,
    T_cw: wp.array,
    camera: CameraIntrinsics,
    count: int,
    out: Splats,
    window: Window | None = None,
) -> None:
    """Project the first ``count`` Gaussians to the screen.

    Culled are Gaussians nearer than 0.05 m, off the screen or the window, whose alpha stays under 1/255,
    or with anything not finite.

    Args:
        means: [>= count] vec3, world frame, metres.
        quats: vec4, w first, any length but zero.
        log_scales: vec3, log of standard deviations in metres.
        opacity_logits: float.
        colours: vec3, degree-0 spherical harmonics.
        identities: vec16, only looked at for numbers that are not finite; or None.
        T_cw: [1] mat44, world to camera.
        camera: see :func:`ggwarp.kernels.camera.intrinsics_of`.
        count: rows in use.
        out: see :class:`Splats`.
        window: the part of the image that matters, whole tiles; None: all of it.
    """
    shown = wp.vec4i(*(window or (0, 0, camera.width, camera.height)))
    launch_split(
        _project,
        count,
        inputs=[means, quats, log_scales, opacity_logits, colours, identities, T_cw, camera, shown],
        outputs=[out.rows, out.depths, out.tile_rects],
        device=means.device,
    )
