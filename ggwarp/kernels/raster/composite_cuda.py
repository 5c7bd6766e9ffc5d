# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing and its adjoint in the form for CUDA: a block of 256 threads is a tile.

Each warp holds a patch of 8 x 4 pixels, so that whole warps skip a splat together. The geometry of 256
splats at a time is staged in shared memory; the opacity threshold is tested on ln alpha, before exp.

The adjoint reduces over the block by products of small matrices: the weights of 16 splats [16, 256]
times d_image [256, 4] give their gradients of colour and depth (with x and y times the depth channel as two
more columns, the gradient of the depth's slope, and one of ones, the weight itself; identities apart, as not
every tile has them), and
d loss / d ln alpha [16, 256] times the monomials 1, x, y, x^2, xy, y^2 [256, 6] the moments that shape
gradients are made of. One row per (splat, tile) slot and a fixed order: no atomics, and the same result
every time.
"""

import warp as wp

from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.composite_patches import (
    ALPHA_MAX,
    DEPTH,
    TRANSMITTANCE_MIN,
    on_tile,
    shape_gradients,
    vec8,
)
from ggwarp.kernels.raster.project import LOG_ALPHA_MIN
from ggwarp.kernels.raster.sampling import first_band, in_sample

# Warp's own loop over small matrices needs no link-time compilation.
wp.set_module_options({"enable_backward": False, "max_unroll": 20, "enable_mathdx_gemm": False})

BLOCK = 256
GROUP = 16
"""Splats whose gradients are reduced together."""


@wp.func
def _column(lane: int) -> int:
    return ((lane >> 5) & 1) * 8 + (lane & 7)


@wp.func
def _row(lane: int) -> int:
    return (lane >> 6) * 4 + ((lane >> 3) & 3)


@wp.func
def _staged(row: vec16, tile_x: int, tile_y: int) -> vec8:
    """Factors of dx^2, dx dy, dy^2 in ln alpha, centre from the tile's corner, slope, ln opacity."""
    s = on_tile(row, tile_x, tile_y)
    return vec8(s[0], s[1], s[2], s[4], s[5], s[6], s[7], s[14])


@wp.func
def _log_alpha(s: vec8, dx: float, dy: float) -> float:
    return dx * (dx * s[0] + dy * s[1]) + dy * dy * s[2] + s[7]


def _make_forward(channels: int):
    with_identity = channels == 20

    @wp.kernel(name=f"composite_cuda_{channels}")
    def forward(
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        rows: wp.array[vec16],
        identities: wp.array[vec16],
        stride: int,
        phase: wp.array[int],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        median_depth: wp.array2d[float],
    ):
        tile, lane = wp.tid()
        tile_y = tile / tiles_x
        tile_x = tile - tile_y * tiles_x
        quarters = wp.array(ptr=rows.ptr, shape=(4 * rows.shape[0],), dtype=wp.vec4)
        splats = wp.tile_empty(shape=BLOCK, dtype=vec8, storage="shared")
        gaussians = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        x = float(_column(lane))
        y = float(_row(lane))
        sampled = first_band(tile_x, tile_y, stride, phase)
        # The same for a whole warp.
        looked_at = in_sample(_row(lane) >> 2, sampled, stride)
        head = wp.vec4()
        identity = vec16()
        T = float(1.0)
        median = float(0.0)
        pairs = tile_ranges[tile]
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, BLOCK)
            s = vec8()
            gaussian = int(0)
            if lane < size:
                gaussian = slot_gaussians[pair_slots[begin + lane]]
                s = _staged(rows[gaussian], tile_x, tile_y)
            wp.tile_scatter_masked(splats, lane, s, lane < size)
            wp.tile_scatter_masked(gaussians, lane, gaussian, lane < size)
            for k in range(size):
                if T >= TRANSMITTANCE_MIN:
                    s = splats[k]
                    dx = x - s[3]
                    dy = y - s[4]
                    power = _log_alpha(s, dx, dy)
                    if power >= LOG_ALPHA_MIN:
                        w = wp.min(wp.exp(power), ALPHA_MAX) * T
                        f = quarters[4 * gaussians[k] + 2]
                        f[DEPTH] += dx * s[5] + dy * s[6]
                        head += f * w
                        if wp.static(with_identity):
                            if looked_at:
                                identity += identities[gaussians[k]] * w
                        after = T - w
                        if T >= 0.5 and after < 0.5:
                            median = f[DEPTH]
                        T = after
            transparent = wp.tile_sum(wp.tile(wp.where(T >= TRANSMITTANCE_MIN, 1, 0)))
            begin += size
            if transparent[0] == 0:
                begin = pairs[1]
        row = tile_y * 16 + _row(lane)
        column = tile_x * 16 + _column(lane)
        for c in range(4):
            image[c, row, column] = head[c]
        if wp.static(with_identity):
            if looked_at:
                for c in range(16):
                    image[4 + c, row, column] = identity[c]
        transmittance[row, column] = T
        median_depth[row, column] = median

    return forward


def _make_adjoint(channels: int):
    with_identity = channels == 20

    # Three blocks fit an SM with 80 registers (some tens of words spill) and 73 KiB of shared memory.
    @wp.kernel(name=f"composite_cuda_adjoint_{channels}", launch_bounds=(BLOCK, 3))
    def adjoint(
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        rows: wp.array[vec16],
        identities: wp.array[vec16],
        stride: int,
        phase: wp.array[int],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        d_image: wp.array3d[float],
        d_transmittance: wp.array2d[float],
        identity_shapes: int,
        slot_rows: wp.array[vec16],
        slot_identities: wp.array[vec16],
    ):
        tile, lane = wp.tid()
        tile_y = tile / tiles_x
        tile_x = tile - tile_y * tiles_x
        row = tile_y * 16 + _row(lane)
        column = tile_x * 16 + _column(lane)
        quarters = wp.array(ptr=rows.ptr, shape=(4 * rows.shape[0],), dtype=wp.vec4)
        slot_floats = wp.array(ptr=slot_identities.ptr, shape=(16 * slot_identities.shape[0],), dtype=float)
        splats = wp.tile_empty(shape=BLOCK, dtype=vec8, storage="shared")
        gaussians = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        slots = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        gradients = wp.tile_empty(shape=(BLOCK, 7), dtype=float, storage="shared")
        monomials = wp.tile_empty(shape=(BLOCK, 6), dtype=float, storage="shared")
        x = float(_column(lane))
        y = float(_row(lane))
        # From the tile's centre: moments about the splat follow with the least cancellation.
        u = x - 7.5
        v = y - 7.5
        wp.tile_scatter_masked(monomials, lane, 0, 1.0, True)
        wp.tile_scatter_masked(monomials, lane, 1, u, True)
        wp.tile_scatter_masked(monomials, lane, 2, v, True)
        wp.tile_scatter_masked(monomials, lane, 3, u * u, True)
        wp.tile_scatter_masked(monomials, lane, 4, u * v, True)
        wp.tile_scatter_masked(monomials, lane, 5, v * v, True)
        g_head = wp.vec4()
        g_identity = vec16()
        sampled = first_band(tile_x, tile_y, stride, phase)
        looked_at = in_sample(_row(lane) >> 2, sampled, stride)
        # What the splats behind the one at hand, and the transmittance, add to the loss.
        rest = transmittance[row, column] * d_transmittance[row, column]
        for c in range(4):
            g_head[c] = d_image[c, row, column]
            rest += g_head[c] * image[c, row, column]
            wp.tile_scatter_masked(gradients, lane, c, g_head[c], True)
        wp.tile_scatter_masked(gradients, lane, 4, g_head[DEPTH] * u, True)
        wp.tile_scatter_masked(gradients, lane, 5, g_head[DEPTH] * v, True)
        wp.tile_scatter_masked(gradients, lane, 6, 1.0, True)
        if wp.static(with_identity):
            identity_gradients = wp.tile_empty(shape=(BLOCK, 16), dtype=float, storage="shared")
            for c in range(16):
                if looked_at:
                    g_identity[c] = d_image[4 + c, row, column]
                    if identity_shapes != 0:
                        rest += g_identity[c] * image[4 + c, row, column]
                wp.tile_scatter_masked(identity_gradients, lane, c, g_identity[c], True)
        T = float(1.0)
        pairs = tile_ranges[tile]
        begin = pairs[0]
        transparent = int(1)
        while begin < pairs[1] and transparent != 0:
            size = wp.min(pairs[1] - begin, BLOCK)
            s = vec8()
            slot = int(0)
            gaussian = int(0)
            if lane < size:
                slot = pair_slots[begin + lane]
                gaussian = slot_gaussians[slot]
                s = _staged(rows[gaussian], tile_x, tile_y)
            wp.tile_scatter_masked(splats, lane, s, lane < size)
            wp.tile_scatter_masked(gaussians, lane, gaussian, lane < size)
            wp.tile_scatter_masked(slots, lane, slot, lane < size)
            for first in range(0, size, GROUP):
                w = vec16()
                d = vec16()
                for k in range(wp.min(size - first, GROUP)):
                    if T >= TRANSMITTANCE_MIN:
                        s = splats[first + k]
                        dx = x - s[3]
                        dy = y - s[4]
                        power = _log_alpha(s, dx, dy)
                        if power >= LOG_ALPHA_MIN:
                            raw = wp.exp(power)
                            alpha = wp.min(raw, ALPHA_MAX)
                            q = wp.dot(quarters[4 * gaussians[first + k] + 2], g_head)
                            q += g_head[DEPTH] * (dx * s[5] + dy * s[6])
                            if wp.static(with_identity):
                                if looked_at and identity_shapes != 0:
                                    q += wp.dot(identities[gaussians[first + k]], g_identity)
                            w[k] = alpha * T
                            rest -= w[k] * q
                            if raw < ALPHA_MAX:
                                d[k] = alpha * (T * q - rest / (1.0 - alpha))
                            T -= w[k]
                sums = wp.tile_matmul(wp.tile(w), gradients)
                moments = wp.tile_matmul(wp.tile(d), monomials)
                if wp.static(with_identity):
                    # GROUP rows of 16 are one number a thread.
                    k = lane >> 4
                    c = lane & 15
                    number = float(0.0)
                    if sampled < 4:
                        identity_sums = wp.tile_matmul(wp.tile(w), identity_gradients)
                        number = identity_sums[k, c]
                    if first + k < size:
                        slot_floats[16 * slots[first + k] + c] = number
                if lane < GROUP and first + lane < size:
                    s = splats[first + lane]
                    slot_rows[slots[first + lane]] = shape_gradients(
                        vec8(s[0], s[1], s[2], s[3], s[4], s[5], s[6], wp.exp(s[7])),
                        vec8(
                            sums[lane, 0], sums[lane, 1], sums[lane, 2],
                            sums[lane, 3], sums[lane, 4], sums[lane, 5], sums[lane, 6], 0.0,
                        ),
                        vec8(
                            moments[lane, 0], moments[lane, 1], moments[lane, 2],
                            moments[lane, 3], moments[lane, 4], moments[lane, 5], 0.0, 0.0,
                        ),
                    )  # fmt: skip
            # Also the barrier before shared memory is written again.
            left = wp.tile_sum(wp.tile(wp.where(T >= TRANSMITTANCE_MIN, 1, 0)))
            transparent = left[0]
            begin += size
        for pair in range(begin + lane, pairs[1], BLOCK):
            slot = pair_slots[pair]
            slot_rows[slot] = vec16()
            if wp.static(with_identity):
                slot_identities[slot] = vec16()

    return adjoint


FORWARD = {channels: _make_forward(channels) for channels in (4, 20)}
"""By the number of channels."""

ADJOINT = {channels: _make_adjoint(channels) for channels in (4, 20)}
"""By the number of channels."""
