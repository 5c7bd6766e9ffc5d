# SPDX-License-Identifier: Apache-2.0
"""Ray-casting of a scene of primitives: exact depth, instance ids, textured colour, baked soft light.

Light is a function of the surface point only: three area lights whose visibility, with the
openness of the surroundings, is baked on a coarse grid, so that a map can represent it.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import translation_of
from ggwarp.kernels.scene.primitives import Primitive, face_of, world_normal
from ggwarp.kernels.scene.rays import (
    TILE,
    Hit,
    blocked,
    cast_at,
    cast_ray,
    on_tangent,
    pixel_ray,
    tile_of,
)
from ggwarp.kernels.scene.shading import Light, shade
from ggwarp.runtime import launch

wp.set_module_options({"enable_backward": False})

_K_TILE = wp.constant(TILE)
_LIGHT_RAYS = wp.constant(6)
_OPEN_RAYS = wp.constant(12)
_OPEN_REACH = wp.constant(0.5)


@wp.kernel
def _bake_light_kernel(offset: int, primitives: wp.array[Primitive], bounds: wp.array[wp.vec4], light: Light):
    index = offset + wp.tid()
    nz = light.grid.shape[2]
    ny = light.grid.shape[1]
    k = index % nz
    j = (index // nz) % ny
    i = index // (nz * ny)
    point = light.origin + light.cell * wp.vec3(float(i), float(j), float(k))
    seen = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for s in range(3):
        centre = wp.vec3(light.centre[s, 0], light.centre[s, 1], light.centre[s, 2])
        half_u = wp.vec3(light.half_u[s, 0], light.half_u[s, 1], light.half_u[s, 2])
        half_v = wp.vec3(light.half_v[s, 0], light.half_v[s, 1], light.half_v[s, 2])
        open = float(0.0)
        for r in range(_LIGHT_RAYS):
            # A fixed lattice over the light: neighbouring cells agree, so shadows stay smooth.
            a = (float(r) + 0.5) / float(_LIGHT_RAYS) * 2.0 - 1.0
            b = (float(r) * 0.6180340 + 0.31) * 2.0
            b = b - 2.0 * wp.floor(0.5 * b) - 1.0
            step = centre + a * half_u + b * half_v - point
            if not blocked(primitives, bounds, point, step, 0.97):
                open += 1.0
        seen[s] = open / float(_LIGHT_RAYS)
    open = float(0.0)
    for r in range(_OPEN_RAYS):
        z = 1.0 - (2.0 * float(r) + 1.0) / float(_OPEN_RAYS)
        angle = 2.3999632 * float(r)
        ring = wp.sqrt(1.0 - z * z)
        step = wp.vec3(ring * wp.cos(angle), ring * wp.sin(angle), z) * _OPEN_REACH
        if not blocked(primitives, bounds, point, step, 1.0):
            open += 1.0
    seen[3] = open / float(_OPEN_RAYS)
    light.grid[i, j, k] = seen


@wp.func
def _insert(
    lists: wp.array2d[int], starts: wp.array2d[float], tile: int, count: int, index: int, start: float
):
    """Put a primitive into a tile's list of ``count``, kept by ascending start."""
    place = int(0)
    for k in range(count):
        if starts[tile, k] <= start:
            place = k + 1
    for k in range(count, place, -1):
        starts[tile, k] = starts[tile, k - 1]
        lists[tile, k] = lists[tile, k - 1]
    starts[tile, place] = start
    lists[tile, place] = index


@wp.kernel
def _cull_kernel(
    offset: int,
    bounds: wp.array[wp.vec4],
    camera: CameraIntrinsics,
    T_wc: wp.mat44,
    lists: wp.array2d[int],
    starts: wp.array2d[float],
    counts: wp.array[int],
):
    """Per tile: the primitives its cone of rays may meet, by the least depth they may have."""
    tile = offset + wp.tid()
    tiles_x = (camera.width + _K_TILE - 1) // _K_TILE
    half = 0.5 * float(_K_TILE)
    u = float((tile % tiles_x) * _K_TILE) - 0.5 + half
    v = float((tile // tiles_x) * _K_TILE) - 0.5 + half
    axis = wp.normalize(pixel_ray(camera, T_wc, u, v))
    cosine = float(1.0)
    for k in range(4):
        du = wp.where(k % 2 == 0, -half, half)
        dv = wp.where(k < 2, -half, half)
        cosine = wp.min(cosine, wp.dot(axis, wp.normalize(pixel_ray(camera, T_wc, u + du, v + dv))))
    sine = wp.sqrt(wp.max(0.0, 1.0 - cosine * cosine))
    origin = translation_of(T_wc)
    forward = wp.vec3(T_wc[0, 2], T_wc[1, 2], T_wc[2, 2])
    count = int(0)
    for i in range(bounds.shape[0]):
        ball = bounds[i]
        to = wp.vec3(ball[0], ball[1], ball[2]) - origin
        along = wp.dot(to, axis)
        across = wp.sqrt(wp.max(0.0, wp.dot(to, to) - along * along))
        if along > -ball[3] and across * cosine - along * sine <= ball[3]:
            start = wp.dot(to, forward) - ball[3]
            _insert(lists, starts, tile, count, i, start)
            count += 1
    counts[tile] = count


@wp.func
def _byte(x: float) -> wp.uint8:
    return wp.uint8(wp.int32(wp.clamp(x, 0.0, 1.0) * 255.0 + 0.5))


@wp.kernel
def _trace_kernel(
    offset: int,
    primitives: wp.array[Primitive],
    lists: wp.array2d[int],
    starts: wp.array2d[float],
    counts: wp.array[int],
    camera: CameraIntrinsics,
    T_wc: wp.mat44,
    faces: wp.array2d[int],
    depth: wp.array2d[float],
    objects: wp.array2d[int],
):
    """What each pixel's centre sees; ``faces`` names the primitive and its face, -1: none."""
    pixel = offset + wp.tid()
    row = pixel // camera.width
    column = pixel % camera.width
    tile = tile_of(camera, column, row)
    direction = pixel_ray(camera, T_wc, float(column), float(row))
    hit = cast_ray(primitives, lists, starts, counts[tile], tile, translation_of(T_wc), direction)
    if hit.index >= 0:
        depth[row, column] = hit.t
        objects[row, column] = primitives[hit.index].object_id
        faces[row, column] = 8 * hit.index + face_of(primitives, hit.index, hit.normal)
    else:
        depth[row, column] = 0.0
        objects[row, column] = 0
        faces[row, column] = -1


@wp.kernel
def _shade_kernel(
    offset: int,
    primitives: wp.array[Primitive],
    lists: wp.array2d[int],
    starts: wp.array2d[float],
    counts: wp.array[int],
    lights: wp.array[Light],
    camera: CameraIntrinsics,
    T_wc: wp.mat44,
    faces: wp.array2d[int],
    colour: wp.array3d[wp.uint8],
):
    pixel = offset + wp.tid()
    row = pixel // camera.width
    column = pixel % camera.width
    tile = tile_of(camera, column, row)
    origin = translation_of(T_wc)
    face = faces[row, column]
    samples = int(1)
    for k in range(9):
        i = wp.clamp(row + k // 3 - 1, 0, camera.height - 1)
        j = wp.clamp(column + k % 3 - 1, 0, camera.width - 1)
        if faces[i, j] != face:
            samples = 4
    # One sample in the middle of a face, where its texture is filtered; four where faces meet.
    spacing = wp.where(samples == 1, 0.0, 0.25)
    reach = wp.where(samples == 1, 0.5, 0.25)
    rgb = wp.vec3(0.0, 0.0, 0.0)
    for s in range(samples):
        u = float(column) + spacing * (2.0 * float(s % 2) - 1.0)
        v = float(row) + spacing * (2.0 * float(s // 2) - 1.0)
        direction = pixel_ray(camera, T_wc, u, v)
        hit = Hit()
        if samples > 1:
            hit = cast_ray(primitives, lists, starts, counts[tile], tile, origin, direction)
        else:
            hit = cast_at(primitives, wp.where(face < 0, -1, face // 8), origin, direction)
        if hit.index >= 0:
            normal = world_normal(primitives[hit.index], hit.normal)
            right = pixel_ray(camera, T_wc, u + reach, v)
            below = pixel_ray(camera, T_wc, u, v + reach)
            side = hit.t * on_tangent(normal, direction, right)
            down = hit.t * on_tangent(normal, direction, below)
            rgb += shade(primitives, hit.index, origin + hit.t * direction, hit.normal, side, down, lights)
    for c in range(3):
        colour[row, column, c] = _byte(rgb[c] / float(samples))


def bake_light(primitives: Any, bounds: Any, light: Any, *, device: Any) -> None:
    """Fill ``light.grid`` [nx, ny, nz] with what each cell's centre sees of the lights and around it.

    Args:
        primitives: [n] Primitive, those that cast shadows.
        bounds: [n] vec4, a ball (centre, radius) around each.
        light: its lights, origin and cell are set, its grid allocated.
    """
    cells = light.grid.shape[0] * light.grid.shape[1] * light.grid.shape[2]
    launch.launch_split(_bake_light_kernel, cells, inputs=[primitives, bounds, light], device=device)


def render(
    primitives: Any,
    bounds: Any,
    lights: Any,
    camera: Any,
    T_wc: Any,
    *,
    lists: Any,
    starts: Any,
    counts: Any,
    faces: Any,
    depth: Any,
    objects: Any,
    colour: Any,
    device: Any,
) -> None:
    """Render one view.

    Args:
        primitives: [n] Primitive.
        bounds: [n] vec4, a ball (centre, radius) around each, metres, world frame.
        lights: [rooms] Light, baked.
        camera: CameraIntrinsics.
        T_wc: wp.mat44 camera-to-world.
        lists, starts: [tiles, n] int and float, scratch; tiles are TILE pixels square, row by row.
        counts: [tiles] int, scratch.
        faces: [h, w] int, scratch.
        depth: [h, w] float out, z-depth at pixel centres, metres; 0 = nothing.
        objects: [h, w] int out, object ids; 0 = nothing.
        colour: [h, w, 3] uint8 out; 2x2 samples where faces meet, else a filtered texture.
    """
    launch.launch_split(
        _cull_kernel,
        counts.shape[0],
        inputs=[bounds, camera, T_wc],
        outputs=[lists, starts, counts],
        device=device,
    )
    launch.launch_split(
        _trace_kernel,
        depth.shape[0] * depth.shape[1],
        inputs=[primitives, lists, starts, counts, camera, T_wc],
        outputs=[faces, depth, objects],
        device=device,
        min_piece=2048,
    )
    launch.launch_split(
        _shade_kernel,
        depth.shape[0] * depth.shape[1],
        inputs=[primitives, lists, starts, counts, lights, camera, T_wc, faces],
        outputs=[colour],
        device=device,
        min_piece=2048,
    )
