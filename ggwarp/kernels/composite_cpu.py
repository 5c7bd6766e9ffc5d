# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing and its adjoint in the form for a CPU.

A task is a tile of 16 x 16 pixels, cut into 16 patches of 4 x 4: a patch is one 16-wide vector, which
LLVM turns into one AVX-512 register (or two of AVX2, four of NEON). A splat touches only the patches
that its ellipse's bounding box touches; compared with rows of 16 pixels that is a third fewer.

Forward, patches are outermost: a list of splats per patch, so that all channels of a patch stay in
registers while its list is walked. In the adjoint splats are outermost: the gradients of a splat
stay in registers while its patches are walked, and each is reduced over the lanes once.
"""

import warp as wp

from ggwarp.kernels.math import vec16

# Contraction across Warp's small functions is what makes multiply-adds; the inlining limit lets the
# whole kernel become one function. Clang's own default vector width is right on every machine.
_OPTIONS = {
    "enable_backward": False,
    "optimization_level": 3,
    "max_unroll": 20,
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=9000 -ffp-contract=fast",
}
wp.set_module_options(_OPTIONS)

vec8 = wp.types.vector(8, wp.float32)

LOG_ALPHA_MIN = wp.constant(-5.541263545158426)
ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
# Splats whose lists are made at a time, and splats between two looks at what is still transparent.
_CHUNK = wp.constant(128)
_LOOK = wp.constant(32)

_LANE_X = wp.constant(vec16(0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0))
_LANE_Y = wp.constant(vec16(0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0))


def _make_exp():
    # One function per kernel: LLVM always inlines a function that is called once.
    @wp.func
    def exp(x: vec16) -> vec16:
        """exp on [-5.6, 0.05], relative error 2e-6: a minimax polynomial of exp(x / 8), to the eighth.

        Outside it is finite, infinite or NaN, and the caller discards it.
        """
        r = x * 1.7897336018226556e-07 + vec16(9.718701615516684e-06)
        r = wp.cw_mul(r, x) + vec16(0.0003242176520565299)
        r = wp.cw_mul(r, x) + vec16(0.007810792176278761)
        r = wp.cw_mul(r, x) + vec16(0.1249992006078217)
        r = wp.cw_mul(r, x) + vec16(0.9999999600539997)
        r = wp.cw_mul(r, r)
        r = wp.cw_mul(r, r)
        return wp.cw_mul(r, r)

    return exp


@wp.func
def _patch_x(patch: int) -> vec16:
    """Pixel columns of a patch's lanes, from the tile's left edge."""
    return _LANE_X + vec16(float((patch & 3) * 4))


@wp.func
def _patch_y(patch: int) -> vec16:
    return _LANE_Y + vec16(float((patch >> 2) * 4))


@wp.func
def _first_quad(tile_x: int, tile_y: int, patch: int, quads: int) -> int:
    """Index of a patch's first four pixels in a plane that is seen as rows of ``quads`` vec4."""
    return (tile_y * 16 + (patch >> 2) * 4) * quads + tile_x * 4 + (patch & 3)


@wp.func
def _load_patch(plane: wp.array[wp.vec4], quad: int, quads: int) -> vec16:
    a = plane[quad]
    b = plane[quad + quads]
    c = plane[quad + 2 * quads]
    d = plane[quad + 3 * quads]
    return vec16(
        a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3], c[0], c[1], c[2], c[3], d[0], d[1], d[2], d[3]
    )


@wp.func
def _store_patch(plane: wp.array[wp.vec4], quad: int, quads: int, v: vec16):
    plane[quad] = wp.vec4(v[0], v[1], v[2], v[3])
    plane[quad + quads] = wp.vec4(v[4], v[5], v[6], v[7])
    plane[quad + 2 * quads] = wp.vec4(v[8], v[9], v[10], v[11])
    plane[quad + 3 * quads] = wp.vec4(v[12], v[13], v[14], v[15])


@wp.func
def _log_opacity(opacity: float) -> float:
    return wp.log(wp.max(opacity, 1.0e-30))


@wp.func
def _span(centre: float, extent: float):
    """First and last-plus-one of the tile's four patches that [centre - extent, centre + extent] meets."""
    first = int(wp.clamp((centre - extent) * 0.25 + 0.2475, 0.0, 4.0))
    last = int(wp.clamp((centre + extent) * 0.25 + 1.0, 0.0, 4.0))
    return first, last


@wp.func
def _patch_rect(x: float, y: float, conic: wp.vec4, log_opacity: float) -> wp.vec4i:
    """Patches (x0, y0, x1, y1), half open, where alpha can reach 1/255; (x, y) from the tile's corner."""
    reach = 2.0 * (log_opacity - LOG_ALPHA_MIN) / (conic[0] * conic[2] - conic[1] * conic[1])
    if not (reach > 0.0):
        return wp.vec4i(0, 0, 0, 0)
    x0, x1 = _span(x, wp.sqrt(reach * conic[2]))
    y0, y1 = _span(y, wp.sqrt(reach * conic[0]))
    return wp.vec4i(x0, y0, x1, y1)


@wp.func
def _sum(v: vec16) -> float:
    """Sum of the lanes, as a tree: a chain of 16 additions would wait for each."""
    a = v[0:8] + v[8:16]
    b = a[0:4] + a[4:8]
    return (b[0] + b[2]) + (b[1] + b[3])


def _make_forward(channels: int):
    accumulators = wp.types.matrix((channels, 16), wp.float32)
    row = wp.types.vector(channels, wp.float32)
    stride = channels + 2
    exp = _make_exp()

    @wp.kernel(name=f"composite_forward_{channels}")
    def forward(
        offset: int,
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        means2d: wp.array[wp.vec2],
        conics: wp.array[wp.vec4],
        depths: wp.array[float],
        features: wp.array2d[float],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        median_depth: wp.array2d[float],
    ):
        tile = offset + wp.tid()
        tile_y = tile // tiles_x
        tile_x = tile - tile_y * tiles_x
        height = image.shape[1]
        quads = image.shape[2] / 4
        # Built here, strides are compile-time constants.
        feature_rows = wp.array(ptr=features.ptr, shape=(features.shape[0],), dtype=row)
        image_quads = wp.array(ptr=image.ptr, shape=(channels * height * quads,), dtype=wp.vec4)
        transmittance_quads = wp.array(ptr=transmittance.ptr, shape=(height * quads,), dtype=wp.vec4)
        median_quads = wp.array(ptr=median_depth.ptr, shape=(height * quads,), dtype=wp.vec4)
        # Per patch: the channels, T and the median depth.
        state = wp.zeros(shape=wp.static(16 * stride), dtype=vec16)
        splats = wp.zeros(shape=wp.static(int(_CHUNK)), dtype=vec8)
        gaussians = wp.zeros(shape=wp.static(int(_CHUNK)), dtype=int)
        lists = wp.zeros(shape=wp.static(16 * int(_CHUNK)), dtype=wp.int16)
        counts = wp.zeros(shape=16, dtype=int)
        # Run-time numbers: Warp unrolls loops over constants, and then compiles for a minute.
        patches = wp.min(tiles_x, 0) + 16
        planes = image.shape[0]
        for patch in range(patches):
            state[patch * stride + channels] = vec16(1.0)
        pairs = tile_ranges[tile]
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, _CHUNK)
            for patch in range(patches):
                counts[patch] = 0
            for k in range(size):
                gaussian = slot_gaussians[pair_slots[begin + k]]
                mean = means2d[gaussian]
                conic = conics[gaussian]
                x = mean[0] - float(tile_x * 16)
                y = mean[1] - float(tile_y * 16)
                log_opacity = _log_opacity(conic[3])
                splats[k] = vec8(
                    x, y, -0.5 * conic[0], -conic[1], -0.5 * conic[2], log_opacity, depths[gaussian], 0.0
                )
                gaussians[k] = gaussian
                rect = _patch_rect(x, y, conic, log_opacity)
                for patch_y in range(rect[1], rect[3]):
                    for patch_x in range(rect[0], rect[2]):
                        patch = patch_y * 4 + patch_x
                        count = counts[patch]
                        lists[patch * _CHUNK + count] = wp.int16(k)
                        counts[patch] = count + 1
            opaque = int(1)
            for patch in range(patches):
                T = state[patch * stride + channels]
                if wp.max(T) >= TRANSMITTANCE_MIN:
                    opaque = 0
                    acc = accumulators()
                    for c in range(channels):
                        acc[c] = state[patch * stride + c]
                    median = state[patch * stride + channels + 1]
                    pixel_x = _patch_x(patch)
                    pixel_y = _patch_y(patch)
                    for i in range(counts[patch]):
                        k = int(lists[patch * _CHUNK + i])
                        s = splats[k]
                        f = feature_rows[gaussians[k]]
                        dx = pixel_x - vec16(s[0])
                        dy = pixel_y - vec16(s[1])
                        power = wp.cw_mul(dx, dx * s[2] + dy * s[3]) + wp.cw_mul(dy, dy * s[4]) + vec16(s[5])
                        alpha = wp.min(exp(power), vec16(ALPHA_MAX))
                        w = vec16()
                        for j in range(16):
                            counted = power[j] >= LOG_ALPHA_MIN and T[j] >= TRANSMITTANCE_MIN
                            w[j] = wp.where(counted, alpha[j] * T[j], 0.0)
                            after = T[j] - w[j]
                            median[j] = wp.where(T[j] >= 0.5 and after < 0.5, s[6], median[j])
                            T[j] = after
                        for c in range(channels):
                            acc[c] += w * f[c]
                    for c in range(channels):
                        state[patch * stride + c] = acc[c]
                    state[patch * stride + channels] = T
                    state[patch * stride + channels + 1] = median
            begin += size
            if opaque == 1:
                begin = pairs[1]
        for patch in range(patches):
            quad = _first_quad(tile_x, tile_y, patch, quads)
            for c in range(planes):
                _store_patch(image_quads, quad + c * height * quads, quads, state[patch * stride + c])
            _store_patch(transmittance_quads, quad, quads, state[patch * stride + channels])
            _store_patch(median_quads, quad, quads, state[patch * stride + channels + 1])

    return forward


def _make_adjoint(channels: int):
    accumulators = wp.types.matrix((channels, 16), wp.float32)
    row = wp.types.vector(channels, wp.float32)
    exp = _make_exp()

    @wp.kernel(name=f"composite_adjoint_{channels}")
    def adjoint(
        offset: int,
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        means2d: wp.array[wp.vec2],
        conics: wp.array[wp.vec4],
        features: wp.array2d[float],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        d_image: wp.array3d[float],
        d_transmittance: wp.array2d[float],
        slot_d_means2d: wp.array[wp.vec2],
        slot_d_conics: wp.array[wp.vec4],
        slot_d_features: wp.array2d[float],
    ):
        tile = offset + wp.tid()
        tile_y = tile // tiles_x
        tile_x = tile - tile_y * tiles_x
        height = image.shape[1]
        quads = image.shape[2] / 4
        feature_rows = wp.array(ptr=features.ptr, shape=(features.shape[0],), dtype=row)
        d_feature_rows = wp.array(ptr=slot_d_features.ptr, shape=(slot_d_features.shape[0],), dtype=row)
        image_quads = wp.array(ptr=image.ptr, shape=(channels * height * quads,), dtype=wp.vec4)
        d_image_quads = wp.array(ptr=d_image.ptr, shape=(channels * height * quads,), dtype=wp.vec4)
        T_quads = wp.array(ptr=transmittance.ptr, shape=(height * quads,), dtype=wp.vec4)
        d_T_quads = wp.array(ptr=d_transmittance.ptr, shape=(height * quads,), dtype=wp.vec4)
        g = wp.zeros(shape=wp.static(16 * channels), dtype=vec16)
        transmittances = wp.zeros(shape=16, dtype=vec16)
        # What the splats behind the present one, and the background, add to the loss.
        behind = wp.zeros(shape=16, dtype=vec16)
        weights = wp.zeros(shape=16, dtype=vec16)
        partial = wp.zeros(shape=wp.static(6 + channels), dtype=vec16)
        reduced = wp.zeros(shape=wp.static(6 + channels), dtype=float)
        patches = wp.min(tiles_x, 0) + 16
        planes = image.shape[0]
        sums = planes + 6
        for patch in range(patches):
            quad = _first_quad(tile_x, tile_y, patch, quads)
            total = wp.cw_mul(_load_patch(T_quads, quad, quads), _load_patch(d_T_quads, quad, quads))
            for c in range(planes):
                plane = quad + c * height * quads
                d = _load_patch(d_image_quads, plane, quads)
                total += wp.cw_mul(d, _load_patch(image_quads, plane, quads))
                g[patch * channels + c] = d
            behind[patch] = total
            transmittances[patch] = vec16(1.0)
        pairs = tile_ranges[tile]
        transparent = int(1)
        for pair in range(pairs[0], pairs[1]):
            if (pair - pairs[0]) % _LOOK == 0 and transparent == 1:
                most = vec16()
                for patch in range(patches):
                    most = wp.max(most, transmittances[patch])
                transparent = wp.where(wp.max(most) >= TRANSMITTANCE_MIN, 1, 0)
            slot = pair_slots[pair]
            gaussian = slot_gaussians[slot]
            mean = means2d[gaussian]
            conic = conics[gaussian]
            f = feature_rows[gaussian]
            x = mean[0] - float(tile_x * 16)
            y = mean[1] - float(tile_y * 16)
            log_opacity = _log_opacity(conic[3])
            rect = _patch_rect(x, y, conic, log_opacity) * transparent
            m0 = vec16()
            mx = vec16()
            my = vec16()
            mxx = vec16()
            mxy = vec16()
            myy = vec16()
            for patch_y in range(rect[1], rect[3]):
                for patch_x in range(rect[0], rect[2]):
                    patch = patch_y * 4 + patch_x
                    dx = _patch_x(patch) - vec16(x)
                    dy = _patch_y(patch) - vec16(y)
                    power = (
                        wp.cw_mul(dx, dx * (-0.5 * conic[0]) + dy * -conic[1])
                        + wp.cw_mul(dy, dy * (-0.5 * conic[2]))
                        + vec16(log_opacity)
                    )
                    raw = exp(power)
                    T = transmittances[patch]
                    q = vec16()
                    for c in range(channels):
                        q += g[patch * channels + c] * f[c]
                    rest = behind[patch]
                    w = vec16()
                    s = vec16()
                    for j in range(16):
                        counted = power[j] >= LOG_ALPHA_MIN and T[j] >= TRANSMITTANCE_MIN
                        alpha = wp.where(counted, wp.min(raw[j], ALPHA_MAX), 0.0)
                        w[j] = alpha * T[j]
                        rest[j] = rest[j] - w[j] * q[j]
                        d_alpha = T[j] * q[j] - rest[j] / (1.0 - alpha)
                        s[j] = wp.where(raw[j] < ALPHA_MAX, alpha * d_alpha, 0.0)
                        T[j] = T[j] - w[j]
                    transmittances[patch] = T
                    behind[patch] = rest
                    weights[patch] = w
                    sx = wp.cw_mul(s, dx)
                    sy = wp.cw_mul(s, dy)
                    m0 += s
                    mx += sx
                    my += sy
                    mxx += wp.cw_mul(sx, dx)
                    mxy += wp.cw_mul(sx, dy)
                    myy += wp.cw_mul(sy, dy)
            partial[0] = m0
            partial[1] = mx
            partial[2] = my
            partial[3] = mxx
            partial[4] = mxy
            partial[5] = myy
            acc = accumulators()
            for patch_y in range(rect[1], rect[3]):
                for patch_x in range(rect[0], rect[2]):
                    patch = patch_y * 4 + patch_x
                    w = weights[patch]
                    for c in range(channels):
                        acc[c] += wp.cw_mul(w, g[patch * channels + c])
            for c in range(channels):
                partial[6 + c] = acc[c]
            for k in range(sums):
                total = partial[k]
                reduced[k] = _sum(total)
            d_row = row()
            for c in range(channels):
                d_row[c] = reduced[6 + c]
            d_feature_rows[slot] = d_row
            x_moment = reduced[1]
            y_moment = reduced[2]
            slot_d_means2d[slot] = wp.vec2(
                conic[0] * x_moment + conic[1] * y_moment, conic[1] * x_moment + conic[2] * y_moment
            )
            slot_d_conics[slot] = wp.vec4(
                -0.5 * reduced[3], -reduced[4], -0.5 * reduced[5], reduced[0] / wp.max(conic[3], 1.0e-30)
            )

    return adjoint


FORWARD = {channels: _make_forward(channels) for channels in (3, 4, 20)}
ADJOINT = {channels: _make_adjoint(channels) for channels in (3, 4, 20)}
