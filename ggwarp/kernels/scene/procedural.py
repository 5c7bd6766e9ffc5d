# SPDX-License-Identifier: Apache-2.0
"""Procedural textures of the synthetic office: device functions, band-limited by construction.

Every pattern takes texture coordinates in metres and the width of the pixel's footprint there.
Periodic edges are integrated exactly over that width (a box filter), noise octaves fade out
before they would alias. A colour therefore depends on the surface point and the footprint alone.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MOTTLED, WOOD, CARPET, WALLPAPER, STRIPES, CHECKER, POSTER = range(7)
SCREEN, MARBLE, RUG, BRICKS, SPINES, GLOBE, WINDOW = range(7, 14)

_K_MOTTLED = wp.constant(MOTTLED)
_K_WOOD = wp.constant(WOOD)
_K_CARPET = wp.constant(CARPET)
_K_WALLPAPER = wp.constant(WALLPAPER)
_K_STRIPES = wp.constant(STRIPES)
_K_CHECKER = wp.constant(CHECKER)
_K_POSTER = wp.constant(POSTER)
_K_SCREEN = wp.constant(SCREEN)
_K_MARBLE = wp.constant(MARBLE)
_K_RUG = wp.constant(RUG)
_K_BRICKS = wp.constant(BRICKS)
_K_SPINES = wp.constant(SPINES)
_K_WINDOW = wp.constant(WINDOW)


@wp.func
def smooth(lo: float, hi: float, x: float) -> float:
    t = wp.clamp((x - lo) / (hi - lo), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def hash01(x: int, y: int, z: int, seed: int) -> float:
    """Integer lattice point -> [0, 1)."""
    h = (
        wp.uint32(x) * wp.uint32(1274126177)
        ^ wp.uint32(y) * wp.uint32(1911520717)
        ^ wp.uint32(z) * wp.uint32(668265263)
        ^ wp.uint32(seed) * wp.uint32(374761393)
    )
    h = (h ^ (h >> wp.uint32(16))) * wp.uint32(2146121005)
    h = (h ^ (h >> wp.uint32(15))) * wp.uint32(1597334677)
    h = h ^ (h >> wp.uint32(16))
    return float(h >> wp.uint32(8)) * (1.0 / 16777216.0)


@wp.func
def noise(p: wp.vec3, seed: int) -> float:
    """Value noise in [-1, 1], one cell a unit, twice differentiable."""
    fx = wp.floor(p[0])
    fy = wp.floor(p[1])
    fz = wp.floor(p[2])
    x = int(fx)
    y = int(fy)
    z = int(fz)
    u = p[0] - fx
    v = p[1] - fy
    w = p[2] - fz
    u = u * u * u * (u * (u * 6.0 - 15.0) + 10.0)
    v = v * v * v * (v * (v * 6.0 - 15.0) + 10.0)
    w = w * w * w * (w * (w * 6.0 - 15.0) + 10.0)
    a = wp.lerp(
        wp.lerp(hash01(x, y, z, seed), hash01(x + 1, y, z, seed), u),
        wp.lerp(hash01(x, y + 1, z, seed), hash01(x + 1, y + 1, z, seed), u),
        v,
    )
    b = wp.lerp(
        wp.lerp(hash01(x, y, z + 1, seed), hash01(x + 1, y, z + 1, seed), u),
        wp.lerp(hash01(x, y + 1, z + 1, seed), hash01(x + 1, y + 1, z + 1, seed), u),
        v,
    )
    return 2.0 * wp.lerp(a, b, w) - 1.0


@wp.func(inline=False)
def fbm(p: wp.vec3, width: float, octaves: int, seed: int) -> float:
    """Fractal noise, about [-1, 1]; ``width``: footprint in cells of the first octave."""
    total = float(0.0)
    amplitude = float(0.6)
    frequency = float(1.0)
    for k in range(octaves):
        fade = 1.0 - smooth(0.4, 1.0, width * frequency)
        if fade <= 0.0:
            break
        total += amplitude * fade * noise(p * frequency, seed + k)
        amplitude *= 0.55
        frequency *= 2.13
    return total


@wp.func
def _pulse_integral(x: float, duty: float) -> float:
    whole = wp.floor(x)
    return whole * duty + wp.min(x - whole, duty)


@wp.func
def pulse(x: float, duty: float, width: float) -> float:
    """Pulse train of period 1 (one on [0, duty)), box-filtered over ``width`` periods."""
    w = wp.max(width, 1.0e-3)
    # Integrated around the nearest period, so that float32 keeps its digits far from zero.
    y = x - wp.floor(x)
    return (_pulse_integral(y + 0.5 * w, duty) - _pulse_integral(y - 0.5 * w, duty)) / w


@wp.func
def cells(x: float, width: float) -> wp.vec3:
    """The cells a footprint touches (first, last) and the last one's share; exact to one cell's width."""
    w = wp.clamp(width, 1.0e-3, 1.0)
    first = wp.floor(x - 0.5 * w)
    last = wp.floor(x + 0.5 * w)
    share = float(0.0)
    if last > first:
        share = (x + 0.5 * w - last) / w
    return wp.vec3(first, last, share)


@wp.func(inline=False)
def cell_value(u: float, v: float, wu: float, wv: float, seed: int) -> float:
    """A random value a unit cell in [0, 1), box-filtered, tending to 0.5 for wide footprints."""
    a = cells(u, wu)
    b = cells(v, wv)
    u0 = int(a[0])
    u1 = int(a[1])
    v0 = int(b[0])
    v1 = int(b[1])
    value = wp.lerp(
        wp.lerp(hash01(u0, v0, 0, seed), hash01(u1, v0, 0, seed), a[2]),
        wp.lerp(hash01(u0, v1, 0, seed), hash01(u1, v1, 0, seed), a[2]),
        b[2],
    )
    return 0.5 + (value - 0.5) / wp.max(1.0, wp.sqrt(wp.max(wu, 1.0) * wp.max(wv, 1.0)))


@wp.func
def disc(u: float, v: float, radius: float, width: float) -> float:
    """A soft disc in the middle of every unit cell."""
    x = u - wp.floor(u) - 0.5
    y = v - wp.floor(v) - 0.5
    w = wp.max(width, 0.02)
    inside = 1.0 - smooth(radius - w, radius + w, wp.sqrt(x * x + y * y))
    fade = smooth(0.5, 1.2, width)
    return wp.lerp(inside, 3.1415927 * radius * radius, fade)


@wp.func
def palette(x: float) -> wp.vec3:
    """A printed-looking hue for x in [0, 1]: smooth, never saturated."""
    return wp.vec3(
        0.52 + 0.33 * wp.cos(6.2831853 * (x + 0.02)),
        0.50 + 0.27 * wp.cos(6.2831853 * (x * 1.3 + 0.35)),
        0.47 + 0.30 * wp.cos(6.2831853 * (x * 0.9 + 0.62)),
    )


@wp.func
def wood(q: wp.vec3, uv: wp.vec2, w: wp.vec2, scale: float, seed: int) -> float:
    """Boards ``scale`` wide along u, ten times as long: tone a board, grain, seams."""
    board = wp.floor(uv[1] / scale)
    shift = 3.7 * hash01(int(board), 5, 0, seed)
    tone = cell_value(
        uv[0] / (10.0 * scale) + shift, uv[1] / scale, w[0] / (10.0 * scale), w[1] / scale, seed
    )
    rings = fbm(wp.vec3(uv[0] / 0.35, uv[1] / 0.035, board * 7.3), wp.max(w[0] / 0.35, w[1] / 0.035), 4, seed)
    blotch = fbm(q / 0.3, wp.max(w[0], w[1]) / 0.3, 2, seed + 9)
    seam = pulse(uv[1] / scale, 0.03, w[1] / scale)
    return wp.clamp(0.15 + 0.5 * tone + 0.22 * rings + 0.12 * blotch - 0.35 * seam, 0.0, 1.0)


@wp.func
def bricks(uv: wp.vec2, w: wp.vec2, scale: float, seed: int) -> wp.vec2:
    """Running bond: (tone of the brick, mortar share)."""
    v = uv[1] / scale
    row = wp.floor(v)
    u = uv[0] / (3.0 * scale) + 0.5 * (row - 2.0 * wp.floor(0.5 * row))
    tone = cell_value(u, v, w[0] / (3.0 * scale), w[1] / scale, seed)
    brick = (1.0 - pulse(u, 0.045, w[0] / (3.0 * scale))) * (1.0 - pulse(v, 0.12, w[1] / scale))
    return wp.vec2(tone, 1.0 - brick)


@wp.func
def poster(uv: wp.vec2, w: wp.vec2, scale: float, a: wp.vec3, b: wp.vec3, seed: int) -> wp.vec3:
    """A print: coloured cells with discs, over a wash from ``a`` to ``b``."""
    u = uv[0] / scale
    v = uv[1] / scale
    wu = w[0] / scale
    wv = w[1] / scale
    ink = palette(cell_value(u, v, wu, wv, seed))
    wash = wp.lerp(a, b, 0.5 + 0.5 * fbm(wp.vec3(u * 0.4, v * 0.4, 3.0), 0.4 * wp.max(wu, wv), 3, seed + 1))
    shown = smooth(0.35, 0.65, cell_value(u, v, wu, wv, seed + 2))
    ground = wp.lerp(wash, ink, 0.85 * shown)
    dot = disc(u, v, 0.36, wp.max(wu, wv)) * smooth(0.3, 0.7, cell_value(u, v, wu, wv, seed + 3))
    second = palette(cell_value(u, v, wu, wv, seed + 4) * 0.7 + 0.3)
    ground = wp.lerp(ground, second, 0.9 * dot)
    rules = pulse(4.0 * v, 0.35, 4.0 * wv) * pulse(0.5 * u + 0.13, 0.5, 0.5 * wu)
    return wp.lerp(ground, a, 0.25 * rules)


@wp.func
def screen(uv: wp.vec2, w: wp.vec2, scale: float, a: wp.vec3, b: wp.vec3, seed: int) -> wp.vec3:
    """Lines of text of differing lengths and colours on ``a``; ``b`` is the margin."""
    v = uv[1] / scale
    wv = w[1] / scale
    line = pulse(v, 0.5, wv)
    word = cell_value(uv[0] / (1.6 * scale), v, w[0] / (1.6 * scale), wv, seed)
    ink = palette(cell_value(0.3 * uv[0] / scale, v, 0.3 * w[0] / scale, wv, seed + 1))
    block = cell_value(
        uv[0] / (9.0 * scale), uv[1] / (7.0 * scale), w[0] / (9.0 * scale), w[1] / (7.0 * scale), seed + 2
    )
    ground = wp.lerp(a, b, smooth(0.45, 0.75, block))
    return wp.lerp(ground, 0.25 * ink + 0.7 * wp.vec3(1.0, 1.0, 1.0), line * smooth(0.3, 0.6, word) * 0.75)


@wp.func
def rug(uv: wp.vec2, w: wp.vec2, scale: float, a: wp.vec3, b: wp.vec3, seed: int) -> wp.vec3:
    """Nested diamonds with a woven texture."""
    r = (wp.abs(uv[0]) + wp.abs(uv[1])) / scale
    # A diagonal's profile across a square pixel is a triangle: narrower than its base.
    wr = 0.7 * (w[0] + w[1]) / scale
    ring = pulse(r, 0.5, wr)
    tone = cell_value(r, 0.5, wr, 0.0, seed)
    base = wp.lerp(a, b, ring)
    base = wp.lerp(base, palette(tone), 0.45 * pulse(r + 0.25, 0.3, wr))
    weave = fbm(wp.vec3(uv[0] / 0.05, uv[1] / 0.05, 0.0), wp.max(w[0], w[1]) / 0.05, 3, seed)
    return base * (1.0 + 0.14 * weave)


@wp.func
def window(uv: wp.vec2, w: wp.vec2, a: wp.vec3, b: wp.vec3, seed: int) -> wp.vec3:
    """A view outside: sky over hills ``b``, soft clouds, lit windows of far houses."""
    height = (
        uv[1]
        + 0.1 * noise(wp.vec3(uv[0] / 0.4, 0.0, 1.0), seed)
        + 0.02 * noise(wp.vec3(uv[0] / 0.07, 5.0, 1.0), seed)
    )
    lost = wp.min(0.6, 2.0 * wp.max(w[0], w[1]))
    cloud = fbm(wp.vec3(uv[0] / 0.35, uv[1] / 0.16, 0.0), wp.max(w[0], w[1]) / 0.16, 4, seed)
    sky = wp.lerp(a, wp.vec3(0.97, 0.97, 0.98), smooth(-0.15 - lost, 0.5 + lost, cloud))
    trees = fbm(wp.vec3(uv[0] / 0.09, uv[1] / 0.09, 4.0), wp.max(w[0], w[1]) / 0.09, 4, seed + 3)
    soft = wp.max(0.01, 0.6 * w[1] + 0.2 * w[0])
    return wp.lerp(b * (1.0 + 0.4 * trees), sky, smooth(-0.2 - soft, -0.2 + soft, height))


@wp.func
def texture(
    pattern: int, a: wp.vec3, b: wp.vec3, scale: float, seed: int, q: wp.vec3, uv: wp.vec2, w: wp.vec2
) -> wp.vec3:
    """Albedo of a surface point.

    Args:
        pattern: which pattern.
        a, b: its two colours.
        scale: its main length, metres.
        q: the point in the primitive's frame, metres (solid noise has no seams).
        uv, w: the point on the face and the footprint's widths there, metres.
    """
    wide = wp.max(w[0], w[1])
    if pattern == _K_WOOD:
        return wp.lerp(a, b, wood(q, uv, w, scale, seed))
    if pattern == _K_POSTER:
        return poster(uv, w, scale, a, b, seed)
    if pattern == _K_SCREEN:
        return screen(uv, w, scale, a, b, seed)
    if pattern == _K_RUG:
        return rug(uv, w, scale, a, b, seed)
    if pattern == _K_WINDOW:
        return window(uv, w, a, b, seed)
    grain = fbm(q / (0.5 * scale), wide / (0.5 * scale), 5, seed)
    if pattern == _K_MOTTLED:
        return wp.lerp(a, b, wp.clamp(0.5 + 0.5 * grain, 0.0, 1.0))
    if pattern == _K_CARPET:
        tile = cell_value(uv[0] / 0.5, uv[1] / 0.5, w[0] / 0.5, w[1] / 0.5, seed)
        pile = fbm(q / 0.03, wide / 0.03, 3, seed + 7)
        return wp.lerp(a, b, wp.clamp(0.25 + 0.35 * tile + 0.3 * grain + 0.25 * pile, 0.0, 1.0))
    if pattern == _K_WALLPAPER:
        stripe = pulse(uv[0] / scale, 0.5, w[0] / scale)
        motif = disc(2.0 * uv[0] / scale, 2.0 * uv[1] / scale, 0.2, 2.0 * wide / scale)
        tone = fbm(q / 0.4, wide / 0.4, 5, seed)
        return wp.lerp(a, b, wp.clamp(0.55 * stripe + 0.3 * motif + 0.14 * tone, 0.0, 1.0))
    if pattern == _K_STRIPES:
        return wp.lerp(a, b, pulse(uv[1] / scale, 0.5, w[1] / scale)) * (1.0 + 0.1 * grain)
    if pattern == _K_CHECKER:
        s = 2.0 * pulse(0.5 * uv[0] / scale, 0.5, 0.5 * w[0] / scale) - 1.0
        t = 2.0 * pulse(0.5 * uv[1] / scale, 0.5, 0.5 * w[1] / scale) - 1.0
        return wp.lerp(a, b, 0.5 + 0.5 * s * t) * (1.0 + 0.08 * grain)
    if pattern == _K_MARBLE:
        bent = q / scale + wp.vec3(grain, grain, -grain) * 0.9
        vein = 1.0 - wp.abs(fbm(bent, wide / scale, 4, seed + 5)) * 2.2
        return wp.lerp(a, b, wp.lerp(smooth(0.2, 1.0, vein), 0.5, smooth(0.1, 0.8, wide / scale)))
    if pattern == _K_BRICKS:
        brick = bricks(uv, w, scale, seed)
        face = wp.lerp(a, b, wp.clamp(brick[0] + 0.25 * grain, 0.0, 1.0))
        return wp.lerp(face, wp.vec3(0.72, 0.70, 0.66), brick[1])
    if pattern == _K_SPINES:
        band = pulse(uv[1] / 0.21 + 0.12, 0.16, w[1] / 0.21)
        title = pulse(uv[1] / 0.03, 0.5, w[1] / 0.03) * pulse(uv[1] / 0.21 + 0.55, 0.35, w[1] / 0.21)
        return wp.lerp(a, b, wp.clamp(0.9 * band + 0.5 * title, 0.0, 1.0)) * (1.0 + 0.12 * grain)
    # The coast blurs by as much as the noise that decides it has lost to its own filter.
    soft = 0.08 + 0.7 * wp.min(1.0, wide / scale)
    land = smooth(-soft, soft, fbm(q / scale, wide / scale, 4, seed))
    return wp.lerp(a, b * (1.0 + 0.25 * grain), land)
