# SPDX-License-Identifier: Apache-2.0
"""Analytic primitives and a ray's first crossing of one: device functions.

A primitive is a unit shape under a rotation and a scale along its own axes:

- box: [-1, 1]^3; sphere: radius 1 (an ellipsoid once scaled); rectangle: z = 0, |x|, |y| <= 1;
- frustum: |z| <= 1, radius 1 at the bottom and ``taper`` at the top, with its caps. A cylinder has
  taper 1, a cone taper 0.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BOX, SPHERE, FRUSTUM, RECTANGLE = range(4)

_K_BOX = wp.constant(BOX)
_K_SPHERE = wp.constant(SPHERE)
_K_FRUSTUM = wp.constant(FRUSTUM)
_FAR = wp.constant(1.0e10)
_EMPTY = wp.constant(1.0e-12)


@wp.struct
class Primitive:
    """A coloured shape; lengths in metres, world frame."""

    kind: int
    object_id: int
    centre: wp.vec3
    to_unit: wp.mat33  # takes a world direction to the unit shape's frame
    size: wp.vec3  # half extents along the unit shape's axes; a rectangle's third is 1
    taper: float
    pattern: int
    turned: int  # texture coordinates swapped
    colour_a: wp.vec3
    colour_b: wp.vec3
    scale: float
    seed: int
    glow: float  # share of the light that is its own


@wp.func
def _hit_box(o: wp.vec3, d: wp.vec3, nearest: float) -> wp.vec4:
    enter = float(-_FAR)
    leave = float(_FAR)
    enter_axis = int(0)
    leave_axis = int(0)
    for k in range(3):
        if wp.abs(d[k]) < _EMPTY:
            if wp.abs(o[k]) > 1.0:
                return wp.vec4(_FAR, 0.0, 0.0, 0.0)
        else:
            inverse = 1.0 / d[k]
            side = wp.abs(inverse)
            t0 = -o[k] * inverse - side
            t1 = -o[k] * inverse + side
            if t0 > enter:
                enter = t0
                enter_axis = k
            if t1 < leave:
                leave = t1
                leave_axis = k
    if enter > leave or leave <= nearest:
        return wp.vec4(_FAR, 0.0, 0.0, 0.0)
    t = enter
    axis = enter_axis
    sign = float(-1.0)
    if enter <= nearest:
        t = leave
        axis = leave_axis
        sign = 1.0
    n = wp.vec3(0.0, 0.0, 0.0)
    n[axis] = wp.where(d[axis] > 0.0, sign, -sign)
    return wp.vec4(t, n[0], n[1], n[2])


@wp.func
def _hit_sphere(o: wp.vec3, d: wp.vec3, nearest: float) -> wp.vec4:
    # ``o`` is the point of the ray closest to the centre, so the roots are opposite.
    span = 1.0 - wp.dot(o, o)
    if span < 0.0:
        return wp.vec4(_FAR, 0.0, 0.0, 0.0)
    t = -wp.sqrt(span / wp.dot(d, d))
    if t <= nearest:
        t = -t
    if t <= nearest:
        return wp.vec4(_FAR, 0.0, 0.0, 0.0)
    n = o + t * d
    return wp.vec4(t, n[0], n[1], n[2])


@wp.func
def _hit_frustum(o: wp.vec3, d: wp.vec3, taper: float, nearest: float) -> wp.vec4:
    best = wp.vec4(_FAR, 0.0, 0.0, 0.0)
    # The side: x^2 + y^2 = (m + k z)^2.
    m = 0.5 * (taper + 1.0)
    k = 0.5 * (taper - 1.0)
    r = m + k * o[2]
    a = d[0] * d[0] + d[1] * d[1] - k * k * d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] - k * d[2] * r
    c = o[0] * o[0] + o[1] * o[1] - r * r
    root = b * b - a * c
    if root >= 0.0:
        s = -(b + wp.where(b < 0.0, -wp.sqrt(root), wp.sqrt(root)))
        for i in range(2):
            t = float(_FAR)
            if i == 0:
                if wp.abs(a) > _EMPTY:
                    t = s / a
            else:
                if wp.abs(s) > _EMPTY:
                    t = c / s
            z = o[2] + t * d[2]
            radius = m + k * z
            if t > nearest and t < best[0] and wp.abs(z) <= 1.0 and radius >= 0.0:
                best = wp.vec4(t, o[0] + t * d[0], o[1] + t * d[1], -k * radius)
    if wp.abs(d[2]) > _EMPTY:
        for i in range(2):
            cap = wp.where(i == 0, -1.0, 1.0)
            edge = wp.where(i == 0, 1.0, taper)
            t = (cap - o[2]) / d[2]
            x = o[0] + t * d[0]
            y = o[1] + t * d[1]
            if t > nearest and t < best[0] and x * x + y * y <= edge * edge:
                best = wp.vec4(t, 0.0, 0.0, cap)
    return best


@wp.func
def _hit_rectangle(o: wp.vec3, d: wp.vec3, nearest: float) -> wp.vec4:
    miss = wp.vec4(_FAR, 0.0, 0.0, 0.0)
    if wp.abs(d[2]) < _EMPTY:
        return miss
    t = -o[2] / d[2]
    x = o[0] + t * d[0]
    y = o[1] + t * d[1]
    if t <= nearest or wp.abs(x) > 1.0 or wp.abs(y) > 1.0:
        return miss
    return wp.vec4(t, 0.0, 0.0, wp.where(d[2] > 0.0, -1.0, 1.0))


@wp.func(inline=False)
def intersect(
    primitives: wp.array[Primitive], index: int, origin: wp.vec3, direction: wp.vec3, nearest: float
) -> wp.vec4:
    """First crossing of a primitive's surface beyond ``nearest``, from outside or inside.

    Returns the ray parameter (1e10: none) and the outward normal of the unit shape, not normalised.
    """
    kind = primitives[index].kind
    to_unit = primitives[index].to_unit
    o = to_unit * (origin - primitives[index].centre)
    d = to_unit * direction
    length2 = wp.dot(d, d)
    # Also false for NaN.
    if not (length2 > 0.0 and wp.dot(o, o) >= 0.0):
        return wp.vec4(_FAR, 0.0, 0.0, 0.0)
    # From the point closest to the centre, small shapes far away keep their digits in float32.
    shift = -wp.dot(o, d) / length2
    o = o + shift * d
    limit = nearest - shift
    hit = wp.vec4(_FAR, 0.0, 0.0, 0.0)
    if kind == _K_BOX:
        hit = _hit_box(o, d, limit)
    elif kind == _K_SPHERE:
        hit = _hit_sphere(o, d, limit)
    elif kind == _K_FRUSTUM:
        hit = _hit_frustum(o, d, primitives[index].taper, limit)
    else:
        hit = _hit_rectangle(o, d, limit)
    if hit[0] < _FAR:
        hit[0] = hit[0] + shift
    return hit


@wp.func
def world_normal(p: Primitive, n: wp.vec3) -> wp.vec3:
    """Unit world normal of a unit shape's normal ``n``."""
    return wp.normalize(wp.transpose(p.to_unit) * n)


@wp.func
def face_of(primitives: wp.array[Primitive], index: int, n: wp.vec3) -> int:
    """Which smooth piece of a unit shape the normal ``n`` belongs to: 0 to 5."""
    if primitives[index].kind == _K_BOX:
        return (
            int(n[0] > 0.5)
            + 2 * int(n[1] > 0.5)
            + 3 * int(n[1] < -0.5)
            + 4 * int(n[2] > 0.5)
            + 5 * int(n[2] < -0.5)
        )
    if primitives[index].kind == _K_FRUSTUM and n[0] == 0.0 and n[1] == 0.0:
        return wp.where(n[2] > 0.0, 1, 2)
    return 0
