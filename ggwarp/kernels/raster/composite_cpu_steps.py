# SPDX-License-Identifier: Apache-2.0
"""Steps of the composite's adjoint on a CPU: see :mod:`ggwarp.kernels.raster.composite_cpu_adjoint`.

Loops are written as they need few instructions.
"""

import warp as wp

from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.composite_patches import (
    ALPHA_MAX,
    TRANSMITTANCE_MIN,
    depth_at,
    exp_in_range,
    log_alpha,
    transpose_quads,
    vec8,
)
from ggwarp.kernels.raster.project import LOG_ALPHA_MIN

wp.set_module_options({"enable_backward": False})

mat16 = wp.types.matrix((16, 16), wp.float32)
mat16x8 = wp.types.matrix((16, 8), wp.float32)
mat4x16 = wp.types.matrix((4, 16), wp.float32)


@wp.func
def load_tile(
    first_line: int,
    lines_across: int,
    plane: int,
    with_identity: bool,
    identity_shapes: int,
    image: wp.array[vec16],
    transmittance: wp.array[vec16],
    d_image: wp.array[vec16],
    d_transmittance: wp.array[vec16],
    g_quads: wp.array[wp.vec4],
    g_identity_quads: wp.array[wp.vec4],
    behind: wp.array[wp.vec4],
    line: wp.array[vec16],
    line_quads: wp.array[wp.vec4],
):
    """Load d_image by patch and channel, and R before the first splat."""
    row = int(0)
    while row < 16:
        at = first_line + row * lines_across
        total = vec16() + wp.cw_mul(transmittance[at], d_transmittance[at])
        to = (row & ~3) * 16 + (row & 3)
        c = int(0)
        while c < 4:
            d = d_image[at]
            total += wp.cw_mul(d, image[at])
            line[0] = d
            for j in range(4):
                g_quads[to + j * 16] = line_quads[j]
            at += plane
            to += 4
            c += 1
        if with_identity:
            to = (row & ~3) * 64 + (row & 3)
            c = int(0)
            while c < 16:
                d = d_image[at]
                if identity_shapes != 0:
                    total += wp.cw_mul(d, image[at])
                line[0] = d
                for j in range(4):
                    g_identity_quads[to + j * 64] = line_quads[j]
                at += plane
                to += 4
                c += 1
        line[0] = total
        for j in range(4):
            behind[(row & ~3) * 4 + 4 * j + (row & 3)] = line_quads[j]
        row += 1


@wp.func
def turn_patch(patch: int, g_quads: wp.array[wp.vec4], weight_quads: wp.array[wp.vec4]):
    """Lay the gradients of a patch's colours and depth out by pixel."""
    x0 = float((patch & 3) * 4) - 7.5
    y0 = float((patch >> 2) * 4) - 7.5
    j = int(0)
    while j < 4:
        pixel = 16 * patch + 4 * j
        at = patch * 16 + j
        for i in range(4):
            d_depth = g_quads[at + 12][i]
            u = x0 + float(i)
            v = y0 + float(j)
            weight_quads[2 * (pixel + i) + 1] = wp.vec4(d_depth * u, d_depth * v, 1.0, 0.0)
        transpose_quads(g_quads, at, weight_quads, 2 * pixel, 2)
        j += 1


@wp.func
def turn_identities(patch: int, g_quads: wp.array[wp.vec4], turned_quads: wp.array[wp.vec4]):
    """Lay the gradients of a patch's identities out by pixel."""
    j = int(0)
    while j < 4:
        b = int(0)
        while b < 4:
            transpose_quads(g_quads, patch * 64 + 16 * b + j, turned_quads, 64 * patch + 16 * j + b, 4)
            b += 1
        j += 1


@wp.func
def take_products(
    count: int,
    head: int,
    lists: wp.array[wp.int16],
    splats: wp.array[vec16],
    gp: mat4x16,
    products: wp.array[vec16],
):
    """q less the depth's part and the identity's."""
    i = int(0)
    while i < count:
        s = splats[int(lists[head + i])]
        q = vec16()
        for c in range(3):
            q += gp[c] * s[8 + c]
        products[i] = q
        i += 1


@wp.func
def add_identity_products(
    count: int,
    head: int,
    lists: wp.array[wp.int16],
    codes: wp.array[vec16],
    gp: mat16,
    products: wp.array[vec16],
):
    """Add the identity's part of q."""
    i = int(0)
    while i < count:
        f = codes[int(lists[head + i])]
        q = products[i]
        for c in range(16):
            q += gp[c] * f[c]
        products[i] = q
        i += 1


@wp.func
def walk(
    count: int,
    head: int,
    patch: int,
    lists: wp.array[wp.int16],
    splats: wp.array[vec16],
    d_depth: vec16,
    products: wp.array[vec16],
    pixels: wp.array[vec16],
    transmittances: wp.array[vec16],
    behind: wp.array[vec16],
    weights: wp.array[vec16],
    slopes: wp.array[vec16],
):
    """Pass the splats front to back: w and d loss / d ln alpha."""
    T = transmittances[patch]
    rest = behind[patch]
    pixel_x = pixels[patch]
    pixel_y = pixels[16 + patch]
    i = int(0)
    while i < count:
        s = splats[int(lists[head + i])]
        dx = pixel_x - vec16(s[4])
        dy = pixel_y - vec16(s[5])
        power = log_alpha(s, dx, dy)
        raw = exp_in_range(power)
        q = products[i] + wp.cw_mul(d_depth, depth_at(s, dx, dy))
        w = vec16()
        d = vec16()
        for j in range(16):
            counted = power[j] >= LOG_ALPHA_MIN and T[j] >= TRANSMITTANCE_MIN
            alpha = wp.where(counted, wp.min(raw[j], ALPHA_MAX), 0.0)
            w[j] = alpha * T[j]
            rest[j] = rest[j] - w[j] * q[j]
            d_alpha = T[j] * q[j] - rest[j] / (1.0 - alpha)
            d[j] = wp.where(raw[j] < ALPHA_MAX, alpha * d_alpha, 0.0)
            T[j] = T[j] - w[j]
        weights[i] = w
        slopes[i] = d
        i += 1
    transmittances[patch] = T
    behind[patch] = rest


@wp.func
def add_identities(
    count: int,
    head: int,
    lists: wp.array[wp.int16],
    weights: wp.array[vec16],
    by_pixel: mat16,
    sums: wp.array[vec16],
):
    i = int(0)
    while i < count:
        k = int(lists[head + i])
        w = weights[i]
        total = sums[k]
        for p in range(16):
            total += by_pixel[p] * w[p]
        sums[k] = total
        i += 1


@wp.func
def add_shapes(
    count: int,
    head: int,
    lists: wp.array[wp.int16],
    weights: wp.array[vec16],
    slopes: wp.array[vec16],
    by_weight: mat16x8,
    by_slope: mat16x8,
    sums: wp.array[vec8],
):
    i = int(0)
    while i < count:
        k = 2 * int(lists[head + i])
        w = weights[i]
        total = sums[k]
        for p in range(16):
            total += by_weight[p] * w[p]
        sums[k] = total
        i += 1
    i = int(0)
    while i < count:
        k = 2 * int(lists[head + i]) + 1
        d = slopes[i]
        total = sums[k]
        for p in range(16):
            total += by_slope[p] * d[p]
        sums[k] = total
        i += 1
