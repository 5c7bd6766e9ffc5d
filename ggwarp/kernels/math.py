# SPDX-License-Identifier: Apache-2.0
"""Small device functions: quaternions, rigid motions, vector types."""

import warp as wp

wp.set_module_options({"enable_backward": False})

vec16 = wp.types.vector(16, wp.float32)
"""A 16-D identity, or a tile row of 16 pixels."""

vec6 = wp.types.vector(6, wp.float32)
"""A twist (translation, rotation) or its gradient."""

mat66 = wp.types.matrix((6, 6), wp.float32)


@wp.func
def quat_to_matrix(q: wp.vec4) -> wp.mat33:
    """Rotation of a *unit* quaternion, w first."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def rotation_of(T: wp.mat44) -> wp.mat33:
    return wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def translation_of(T: wp.mat44) -> wp.vec3:
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def transform_point(T: wp.mat44, p: wp.vec3) -> wp.vec3:
    return rotation_of(T) * p + translation_of(T)
