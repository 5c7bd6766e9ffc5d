# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing and its adjoint in the form for CUDA: a block of 256 threads is a tile.

Each warp holds a patch of 8 x 4 pixels, so that whole warps skip a splat together. The geometry of 256
splats at a time is staged in shared memory; the opacity threshold is tested on ln alpha, before exp.

The adjoint reduces over the block by products of small matrices: the weights of 16 splats [16, 256]
times d_image [256, C] give their feature gradients (with x and y times its depth channel as two more
columns: the gradient of the depth's slope), and d loss / d ln alpha [16, 256] times the monomials 1, x, y,
x^2, xy, y^2 [256, 6] the moments that shape gradients are made of. One row per (splat, tile) slot and a
fixed order: no atomics, and the same result every time.
"""

import warp as wp

from ggwarp.kernels.composite_patches import (
    ALPHA_MAX,
    DEPTH,
    LOG_ALPHA_MIN,
    TRANSMITTANCE_MIN,
    gathered,
    quadratic,
    vec8,
)
from ggwarp.kernels.math import vec16

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
def _log_alpha(s: vec8, dx: float, dy: float) -> float:
    return dx * (dx * s[2] + dy * s[3]) + dy * dy * s[4] + s[5]


def _make_forward(channels: int):
    feature_row = wp.types.vector(channels, wp.float32)

    @wp.kernel(name=f"composite_cuda_{channels}")
    def forward(
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        means2d: wp.array[wp.vec2],
        conics: wp.array[wp.vec4],
        slopes: wp.array[wp.vec2],
        features: wp.array2d[float],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        median_depth: wp.array2d[float],
    ):
        tile, lane = wp.tid()
        tile_y = tile / tiles_x
        tile_x = tile - tile_y * tiles_x
        feature_rows = wp.array(ptr=features.ptr, shape=(features.shape[0],), dtype=feature_row)
        splats = wp.tile_empty(shape=BLOCK, dtype=vec8, storage="shared")
        gaussians = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        x = float(_column(lane))
        y = float(_row(lane))
        acc = feature_row()
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
                s = quadratic(gathered(means2d[gaussian], conics[gaussian], slopes[gaussian]), tile_x, tile_y)
            wp.tile_scatter_masked(splats, lane, s, lane < size)
            wp.tile_scatter_masked(gaussians, lane, gaussian, lane < size)
            for k in range(size):
                if T >= TRANSMITTANCE_MIN:
                    s = splats[k]
                    dx = x - s[0]
                    dy = y - s[1]
                    power = _log_alpha(s, dx, dy)
                    if power >= LOG_ALPHA_MIN:
                        w = wp.min(wp.exp(power), ALPHA_MAX) * T
                        f = feature_rows[gaussians[k]]
                        f[DEPTH] += dx * s[6] + dy * s[7]
                        acc += f * w
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
        for c in range(channels):
            image[c, row, column] = acc[c]
        transmittance[row, column] = T
        median_depth[row, column] = median

    return forward


def _make_adjoint(channels: int):
    feature_row = wp.types.vector(channels, wp.float32)
    columns = channels + 2

    # Three blocks fit an SM with 80 registers (some tens of words spill) and 73 KiB of shared memory.
    @wp.kernel(name=f"composite_cuda_adjoint_{channels}", launch_bounds=(BLOCK, 3))
    def adjoint(
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        means2d: wp.array[wp.vec2],
        conics: wp.array[wp.vec4],
        slopes: wp.array[wp.vec2],
        features: wp.array2d[float],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        d_image: wp.array3d[float],
        d_transmittance: wp.array2d[float],
        slot_d_means2d: wp.array[wp.vec2],
        slot_d_conics: wp.array[wp.vec4],
        slot_d_slopes: wp.array[wp.vec2],
        slot_d_features: wp.array2d[float],
    ):
        tile, lane = wp.tid()
        tile_y = tile / tiles_x
        tile_x = tile - tile_y * tiles_x
        row = tile_y * 16 + _row(lane)
        column = tile_x * 16 + _column(lane)
        feature_rows = wp.array(ptr=features.ptr, shape=(features.shape[0],), dtype=feature_row)
        splats = wp.tile_empty(shape=BLOCK, dtype=vec8, storage="shared")
        gaussians = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        slots = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        gradients = wp.tile_empty(shape=(BLOCK, columns), dtype=float, storage="shared")
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
        g = feature_row()
        # What the splats behind the one at hand, and the transmittance, add to the loss.
        rest = transmittance[row, column] * d_transmittance[row, column]
        for c in range(channels):
            g[c] = d_image[c, row, column]
            rest += g[c] * image[c, row, column]
            wp.tile_scatter_masked(gradients, lane, c, g[c], True)
        wp.tile_scatter_masked(gradients, lane, channels, g[DEPTH] * u, True)
        wp.tile_scatter_masked(gradients, lane, channels + 1, g[DEPTH] * v, True)
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
                s = quadratic(gathered(means2d[gaussian], conics[gaussian], slopes[gaussian]), tile_x, tile_y)
            wp.tile_scatter_masked(splats, lane, s, lane < size)
            wp.tile_scatter_masked(gaussians, lane, gaussian, lane < size)
            wp.tile_scatter_masked(slots, lane, slot, lane < size)
            for first in range(0, size, GROUP):
                w = vec16()
                d = vec16()
                for k in range(wp.min(size - first, GROUP)):
                    if T >= TRANSMITTANCE_MIN:
                        s = splats[first + k]
                        dx = x - s[0]
                        dy = y - s[1]
                        power = _log_alpha(s, dx, dy)
                        if power >= LOG_ALPHA_MIN:
                            raw = wp.exp(power)
                            alpha = wp.min(raw, ALPHA_MAX)
                            q = wp.dot(feature_rows[gaussians[first + k]], g)
                            q += g[DEPTH] * (dx * s[6] + dy * s[7])
                            w[k] = alpha * T
                            rest -= w[k] * q
                            if raw < ALPHA_MAX:
                                d[k] = alpha * (T * q - rest / (1.0 - alpha))
                            T -= w[k]
                sums = wp.tile_matmul(wp.tile(w), gradients)
                moments = wp.tile_matmul(wp.tile(d), monomials)
                for e in range(lane, GROUP * channels, BLOCK):
                    k = e / channels
                    c = e - k * channels
                    if first + k < size:
                        slot_d_features[slots[first + k], c] = sums[k, c]
                if lane < GROUP and first + lane < size:
                    slot = slots[first + lane]
                    s = splats[first + lane]
                    ox = 7.5 - s[0]
                    oy = 7.5 - s[1]
                    m0 = moments[lane, 0]
                    u1 = moments[lane, 1]
                    v1 = moments[lane, 2]
                    mx = u1 + ox * m0
                    my = v1 + oy * m0
                    mxx = moments[lane, 3] + ox * (u1 + mx)
                    mxy = moments[lane, 4] + ox * v1 + oy * mx
                    myy = moments[lane, 5] + oy * (v1 + my)
                    # The depth's plane moves with the mean.
                    d_depth = sums[lane, DEPTH]
                    slot_d_means2d[slot] = wp.vec2(
                        -2.0 * s[2] * mx - s[3] * my - s[6] * d_depth,
                        -s[3] * mx - 2.0 * s[4] * my - s[7] * d_depth,
                    )
                    slot_d_conics[slot] = wp.vec4(-0.5 * mxx, -mxy, -0.5 * myy, m0 * wp.exp(-s[5]))
                    slot_d_slopes[slot] = wp.vec2(
                        sums[lane, channels] + ox * d_depth, sums[lane, channels + 1] + oy * d_depth
                    )
            # Also the barrier before shared memory is written again.
            left = wp.tile_sum(wp.tile(wp.where(T >= TRANSMITTANCE_MIN, 1, 0)))
            transparent = left[0]
            begin += size
        for pair in range(begin + lane, pairs[1], BLOCK):
            slot = pair_slots[pair]
            slot_d_means2d[slot] = wp.vec2()
            slot_d_conics[slot] = wp.vec4()
            slot_d_slopes[slot] = wp.vec2()
            for c in range(channels):
                slot_d_features[slot, c] = 0.0

    return adjoint


FORWARD = {channels: _make_forward(channels) for channels in (4, 20)}
"""By the number of channels."""

ADJOINT = {channels: _make_adjoint(channels) for channels in (4, 20)}
"""By the number of channels."""
