# SPDX-License-Identifier: Apache-2.0
"""Rigid motions in double precision, as device functions."""

import warp as wp

from ggwarp.kernels.math import vec6d

wp.set_module_options({"enable_backward": False})


@wp.func
def rotation_d(T: wp.mat44d) -> wp.mat33d:
    return wp.mat33d(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def translation_d(T: wp.mat44d) -> wp.vec3d:
    return wp.vec3d(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def to_double(p: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))


@wp.func
def matrix_to_double(A: wp.mat33) -> wp.mat33d:
    return wp.mat33d(
        wp.float64(A[0, 0]), wp.float64(A[0, 1]), wp.float64(A[0, 2]),
        wp.float64(A[1, 0]), wp.float64(A[1, 1]), wp.float64(A[1, 2]),
        wp.float64(A[2, 0]), wp.float64(A[2, 1]), wp.float64(A[2, 2]),
    )  # fmt: skip


@wp.func
def single_matrix(A: wp.mat33d) -> wp.mat33:
    return wp.mat33(
        float(A[0, 0]), float(A[0, 1]), float(A[0, 2]),
        float(A[1, 0]), float(A[1, 1]), float(A[1, 2]),
        float(A[2, 0]), float(A[2, 1]), float(A[2, 2]),
    )  # fmt: skip


@wp.func
def se3_exp(xi: vec6d) -> wp.mat44d:
    """Rigid motion of a twist (translation, rotation)."""
    v = wp.vec3d(xi[0], xi[1], xi[2])
    w = wp.vec3d(xi[3], xi[4], xi[5])
    one = wp.float64(1.0)
    theta2 = wp.dot(w, w)
    a = one - theta2 / wp.float64(6.0)
    b = wp.float64(0.5) - theta2 / wp.float64(24.0)
    c = one / wp.float64(6.0) - theta2 / wp.float64(120.0)
    if theta2 > wp.float64(1.0e-8):
        theta = wp.sqrt(theta2)
        half = wp.sin(wp.float64(0.5) * theta) / theta
        a = wp.sin(theta) / theta
        b = wp.float64(2.0) * half * half
        c = (theta - wp.sin(theta)) / (theta2 * theta)
    W = wp.skew(w)
    W2 = W * W
    eye = wp.identity(n=3, dtype=wp.float64)
    R = eye + a * W + b * W2
    t = (eye + b * W + c * W2) * v
    zero = wp.float64(0.0)
    return wp.mat44d(
        R[0, 0], R[0, 1], R[0, 2], t[0],
        R[1, 0], R[1, 1], R[1, 2], t[1],
        R[2, 0], R[2, 1], R[2, 2], t[2],
        zero, zero, zero, one,
    )  # fmt: skip


@wp.func
def se3_log(T: wp.mat44d) -> vec6d:
    """Twist (translation, rotation) of a rigid motion that turns by less than a half turn."""
    one = wp.float64(1.0)
    half = wp.float64(0.5)
    # sin(theta) times the axis, and cos(theta).
    s = half * wp.vec3d(T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1])
    sine = wp.length(s)
    cosine = half * (T[0, 0] + T[1, 1] + T[2, 2] - one)
    theta = wp.atan2(sine, cosine)
    theta2 = theta * theta
    scale = one + theta2 / wp.float64(6.0)
    c = one / wp.float64(12.0) + theta2 / wp.float64(720.0)
    if theta2 > wp.float64(1.0e-8):
        scale = theta / sine
        c = (one - half * theta / wp.tan(half * theta)) / theta2
    w = scale * s
    t = translation_d(T)
    wt = wp.cross(w, t)
    v = t - half * wt + c * wp.cross(w, wt)
    return vec6d(v[0], v[1], v[2], w[0], w[1], w[2])


@wp.func
def orthonormalised(T: wp.mat44d) -> wp.mat44d:
    """One Newton step towards the nearest rotation: undoes the rounding of many updates."""
    R = rotation_d(T)
    S = wp.float64(1.5) * wp.identity(n=3, dtype=wp.float64) - wp.float64(0.5) * (wp.transpose(R) * R)
    R = R * S
    for r in range(3):
        for c in range(3):
            T[r, c] = R[r, c]
    return T
