# SPDX-License-Identifier: Apache-2.0
"""Colour of a surface point of a built-in scene: texture times baked soft light, no view dependence."""

import warp as wp

from ggwarp.kernels.scene.primitives import BOX, FRUSTUM, SPHERE, Primitive, world_normal
from ggwarp.kernels.scene.procedural import texture

wp.set_module_options({"enable_backward": False})

_K_BOX = wp.constant(BOX)
_K_SPHERE = wp.constant(SPHERE)
_K_FRUSTUM = wp.constant(FRUSTUM)


@wp.struct
class Light:
    """A room's three rectangular lights and the baked grid of what reaches each point.

    ``grid`` holds the visible share of each light and the openness, per cell centre.
    """

    low: wp.vec3  # the room's corners
    high: wp.vec3
    centre: wp.mat33  # row k: centre of light k
    half_u: wp.mat33  # row k: half of its first side
    half_v: wp.mat33
    power: wp.vec3
    ambient: float
    origin: wp.vec3  # centre of grid cell (0, 0, 0)
    cell: float
    grid: wp.array3d[wp.vec4]


@wp.func
def _room_of(lights: wp.array[Light], point: wp.vec3) -> int:
    """The room that holds ``point``, or the one nearest to it: a doorway is part of either."""
    best = int(0)
    nearest = float(1.0e10)
    for r in range(lights.shape[0]):
        low = lights[r].low
        high = lights[r].high
        outside = wp.vec3(
            wp.max(wp.max(low[0] - point[0], point[0] - high[0]), 0.0),
            wp.max(wp.max(low[1] - point[1], point[1] - high[1]), 0.0),
            wp.max(wp.max(low[2] - point[2], point[2] - high[2]), 0.0),
        )
        distance = wp.length_sq(outside)
        if distance < nearest:
            nearest = distance
            best = r
    return best


@wp.func
def _light_at(light: Light, point: wp.vec3, normal: wp.vec3) -> float:
    """Irradiance of a surface point, display units."""
    nx = light.grid.shape[0]
    ny = light.grid.shape[1]
    nz = light.grid.shape[2]
    # One cell off the surface: the eight cells read lie on its open side.
    g = (point + light.cell * normal - light.origin) / light.cell
    x = wp.clamp(g[0], 0.0, float(nx) - 1.001)
    y = wp.clamp(g[1], 0.0, float(ny) - 1.001)
    z = wp.clamp(g[2], 0.0, float(nz) - 1.001)
    i = int(x)
    j = int(y)
    k = int(z)
    u = x - float(i)
    v = y - float(j)
    w = z - float(k)
    low = wp.lerp(
        wp.lerp(light.grid[i, j, k], light.grid[i + 1, j, k], u),
        wp.lerp(light.grid[i, j + 1, k], light.grid[i + 1, j + 1, k], u),
        v,
    )
    high = wp.lerp(
        wp.lerp(light.grid[i, j, k + 1], light.grid[i + 1, j, k + 1], u),
        wp.lerp(light.grid[i, j + 1, k + 1], light.grid[i + 1, j + 1, k + 1], u),
        v,
    )
    seen = wp.lerp(low, high, w)
    total = light.ambient * (0.35 + 0.65 * seen[3])
    for s in range(3):
        to = wp.vec3(light.centre[s, 0], light.centre[s, 1], light.centre[s, 2]) - point
        distance2 = wp.dot(to, to)
        # Half-Lambert: soft, and no surface goes black.
        facing = 0.5 + 0.5 * wp.dot(to, normal) / wp.sqrt(distance2 + 1.0e-6)
        total += light.power[s] * seen[s] * facing * facing / (1.0 + 0.25 * distance2)
    return total


@wp.func(inline=False)
def shade(
    primitives: wp.array[Primitive],
    index: int,
    point: wp.vec3,
    n: wp.vec3,
    side: wp.vec3,
    down: wp.vec3,
    lights: wp.array[Light],
) -> wp.vec3:
    """Colour of a surface point in 0..1.

    Args:
        point: world position, metres.
        n: unit shape's normal.
        side, down: half the sample's width and height on the surface, world frame, metres.
        lights: of each room.
    """
    p = primitives[index]
    q = wp.cw_mul(p.size, p.to_unit * (point - p.centre))
    # Half the footprint each way, along the primitive's axes.
    half_u = wp.cw_mul(p.size, p.to_unit * side)
    half_v = wp.cw_mul(p.size, p.to_unit * down)
    footprint = wp.vec3(
        2.0 * (wp.abs(half_u[0]) + wp.abs(half_v[0])),
        2.0 * (wp.abs(half_u[1]) + wp.abs(half_v[1])),
        2.0 * (wp.abs(half_u[2]) + wp.abs(half_v[2])),
    )
    m = wp.vec3(wp.abs(n[0]), wp.abs(n[1]), wp.abs(n[2]))
    uv = wp.vec2(q[0], q[1])
    w = wp.vec2(footprint[0], footprint[1])
    if p.kind == _K_BOX:
        if m[0] > 0.5:
            uv = wp.vec2(q[1], q[2])
            w = wp.vec2(footprint[1], footprint[2])
        elif m[1] > 0.5:
            uv = wp.vec2(q[0], q[2])
            w = wp.vec2(footprint[0], footprint[2])
    elif p.kind == _K_SPHERE or (p.kind == _K_FRUSTUM and m[0] + m[1] > 0.0):
        radius = 0.5 * (p.size[0] + p.size[1])
        uv = wp.vec2(wp.atan2(q[1], q[0]) * radius, q[2])
        around = wp.sqrt(footprint[0] * footprint[0] + footprint[1] * footprint[1])
        w = wp.vec2(around, footprint[2])
    if p.turned != 0:
        uv = wp.vec2(uv[1], uv[0])
        w = wp.vec2(w[1], w[0])
    albedo = texture(p.pattern, p.colour_a, p.colour_b, p.scale, p.seed, q, uv, w)
    lit = _light_at(lights[_room_of(lights, point)], point, world_normal(p, n))
    return albedo * (p.glow + (1.0 - p.glow) * lit)
