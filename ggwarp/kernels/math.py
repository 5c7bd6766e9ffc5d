# SPDX-License-Identifier: Apache-2.0
"""Small device functions: quaternions, rigid motions, vector types."""

import warp as wp

wp.set_module_options({"enable_backward": False})

VECTOR_OPTIONS = {
    "enable_backward": False,
    "optimization_level": 3,
    "max_unroll": 32,
    # Multiply-adds form only where contraction may cross Warp's small functions.
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -ffp-contract=fast",
}
"""Module options of CPU kernels that work on whole vectors."""

vec16 = wp.types.vector(16, wp.float32)
"""A 16-D identity, or a tile row of 16 pixels."""

vec6 = wp.types.vector(6, wp.float32)
"""A twist (translation, rotation) or its gradient."""


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


vec6d = wp.types.vector(6, wp.float64)
"""A twist in double precision."""

mat66d = wp.types.matrix((6, 6), wp.float64)


@wp.func
def solve_positive(H: mat66d, g: vec6d) -> vec6d:
    """Solve H x = g by Cholesky; zero where the matrix is not positive definite."""
    L = mat66d()
    for r in range(6):
        for c in range(r + 1):
            s = H[r, c]
            for k in range(c):
                s -= L[r, k] * L[c, k]
            if r == c:
                if not (s > wp.float64(0.0)):
                    return vec6d()
                L[r, r] = wp.sqrt(s)
            else:
                L[r, c] = s / L[c, c]
    x = vec6d()
    for r in range(6):
        s = g[r]
        for k in range(r):
            s -= L[r, k] * x[k]
        x[r] = s / L[r, r]
    for b in range(6):
        r = 5 - b
        s = x[r]
        for k in range(r + 1, 6):
            s -= L[k, r] * x[k]
        x[r] = s / L[r, r]
    return x


@wp.func
def covariance_of(q: wp.vec4, s: wp.vec3) -> wp.mat33:
    """R diag(s^2) R^T of a *unit* quaternion, w first, and standard deviations."""
    A = quat_to_matrix(q) @ wp.diag(s)
    return A @ wp.transpose(A)


@wp.func
def matrix_to_quat(R: wp.mat33) -> wp.vec4:
    """Unit quaternion, w first and w >= 0, of a rotation."""
    q = wp.quat_from_matrix(R)
    sign = 1.0
    if q[3] < 0.0:
        sign = -1.0
    return sign * wp.vec4(q[3], q[0], q[1], q[2])


@wp.func
def eigen_symmetric(A: wp.mat33):
    """Eigenvalues, falling, and a *rotation* whose columns are the eigenvectors of a symmetric matrix."""
    size = wp.max(wp.max(wp.abs(A[0, 0]), wp.abs(A[1, 1])), wp.abs(A[2, 2]))
    if not (size > 0.0):
        return wp.vec3(0.0, 0.0, 0.0), wp.identity(n=3, dtype=wp.float32)
    # Scaled to about one: the iteration's thresholds are absolute.
    vectors, values = wp.eig3(A / size)
    e = values
    x = wp.vec3(vectors[0, 0], vectors[1, 0], vectors[2, 0])
    y = wp.vec3(vectors[0, 1], vectors[1, 1], vectors[2, 1])
    z = wp.vec3(vectors[0, 2], vectors[1, 2], vectors[2, 2])
    if e[0] < e[1]:
        e = wp.vec3(e[1], e[0], e[2])
        t = x
        x = y
        y = t
    if e[1] < e[2]:
        e = wp.vec3(e[0], e[2], e[1])
        t = y
        y = z
        z = t
    if e[0] < e[1]:
        e = wp.vec3(e[1], e[0], e[2])
        t = x
        x = y
        y = t
    x = wp.normalize(x)
    y = wp.normalize(y - wp.dot(x, y) * x)
    z = wp.cross(x, y)
    return size * e, wp.mat33(x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2])


@wp.func
def quat_to_matrix_adjoint(q: wp.vec4, g: wp.mat33) -> wp.vec4:
    """Gradient with respect to the unit quaternion, given that of its matrix."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    yz = g[1, 2] + g[2, 1]
    zx = g[2, 0] + g[0, 2]
    xy = g[0, 1] + g[1, 0]
    u = g[2, 1] - g[1, 2]
    v = g[0, 2] - g[2, 0]
    t = g[1, 0] - g[0, 1]
    return 2.0 * wp.vec4(
        x * u + y * v + z * t,
        w * u - 2.0 * x * (g[1, 1] + g[2, 2]) + y * xy + z * zx,
        w * v + x * xy - 2.0 * y * (g[0, 0] + g[2, 2]) + z * yz,
        w * t + x * zx + y * yz - 2.0 * z * (g[0, 0] + g[1, 1]),
    )
