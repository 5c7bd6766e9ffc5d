# SPDX-License-Identifier: Apache-2.0
"""Rays of a pinhole camera and what they meet first: device functions of the ray-caster."""

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import rotation_of
from ggwarp.kernels.scene.primitives import Primitive, intersect

wp.set_module_options({"enable_backward": False})

TILE = 8
"""Pixels along the side of a tile that shares one list of candidate primitives."""

_K_TILE = wp.constant(TILE)
_FAR = wp.constant(1.0e10)
_NEAREST = wp.constant(1.0e-3)


@wp.struct
class Hit:
    """A ray's first crossing: its parameter, the primitive (-1: none), the unit shape's normal."""

    t: float
    index: int
    normal: wp.vec3


@wp.func
def pixel_ray(camera: CameraIntrinsics, T_wc: wp.mat44, u: float, v: float) -> wp.vec3:
    """World direction of a pixel's ray, its length such that the ray parameter is the z-depth."""
    return rotation_of(T_wc) * wp.vec3((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0)


@wp.func
def tile_of(camera: CameraIntrinsics, column: int, row: int) -> int:
    return (row // _K_TILE) * ((camera.width + _K_TILE - 1) // _K_TILE) + column // _K_TILE


@wp.func
def on_tangent(normal: wp.vec3, direction: wp.vec3, shifted: wp.vec3) -> wp.vec3:
    """How far a point at depth 1 moves on its tangent plane when its ray becomes ``shifted``."""
    facing = wp.dot(normal, shifted)
    # Seen edge-on the pixel's footprint has no end: held to 20 times its width.
    least = 0.05 * wp.length(shifted)
    if wp.abs(facing) < least:
        facing = wp.where(facing < 0.0, -least, least)
    return shifted * (wp.dot(normal, direction) / facing) - direction


@wp.func(inline=False)
def blocked(
    primitives: wp.array[Primitive], bounds: wp.array[wp.vec4], origin: wp.vec3, step: wp.vec3, reach: float
) -> bool:
    """Whether a primitive lies on the segment from ``origin`` along ``step``, up to ``reach`` of it."""
    length2 = wp.dot(step, step)
    for i in range(bounds.shape[0]):
        ball = bounds[i]
        to = wp.vec3(ball[0], ball[1], ball[2]) - origin
        along = wp.clamp(wp.dot(to, step) / length2, 0.0, reach)
        off = to - along * step
        if wp.dot(off, off) <= ball[3] * ball[3]:
            hit = intersect(primitives, i, origin, step, 0.0)
            if hit[0] < reach:
                return True
    return False


@wp.func(inline=False)
def cast_ray(
    primitives: wp.array[Primitive],
    lists: wp.array2d[int],
    starts: wp.array2d[float],
    count: int,
    tile: int,
    origin: wp.vec3,
    direction: wp.vec3,
) -> Hit:
    best = Hit()
    best.t = _FAR
    best.index = -1
    for c in range(count):
        if starts[tile, c] > best.t:
            break
        i = lists[tile, c]
        hit = intersect(primitives, i, origin, direction, _NEAREST)
        if hit[0] < best.t:
            best.t = hit[0]
            best.index = i
            best.normal = wp.vec3(hit[1], hit[2], hit[3])
    return best


@wp.func
def cast_at(primitives: wp.array[Primitive], index: int, origin: wp.vec3, direction: wp.vec3) -> Hit:
    """The crossing of a primitive that is known to be the first; ``index`` < 0: none."""
    hit = Hit()
    hit.index = index
    if index >= 0:
        crossing = intersect(primitives, index, origin, direction, _NEAREST)
        hit.t = crossing[0]
        hit.normal = wp.vec3(crossing[1], crossing[2], crossing[3])
    return hit
