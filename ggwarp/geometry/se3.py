# SPDX-License-Identifier: Apache-2.0
"""SE(3) in NumPy float64: exponential, logarithm, adjoint, quaternions.

Twists are ordered (translation, rotation): xi = (v, w), metres and radians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def hat(w: ArrayLike) -> Array:
    """Return the [3, 3] cross-product matrix of ``w`` [3]."""
    x, y, z = np.asarray(w, np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _series(theta: float) -> tuple[float, float, float]:
    """Return sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3, stable near zero."""
    if theta < 1e-4:
        t2 = theta * theta
        return 1.0 - t2 / 6.0, 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    return (
        np.sin(theta) / theta,
        2.0 * (np.sin(theta / 2.0) / theta) ** 2,
        (theta - np.sin(theta)) / theta**3,
    )


def so3_exp(w: ArrayLike) -> Array:
    """Return the [3, 3] rotation of the rotation vector ``w`` [3]."""
    w = np.asarray(w, np.float64)
    a, b, _ = _series(float(np.linalg.norm(w)))
    W = hat(w)
    return np.eye(3) + a * W + b * (W @ W)


def so3_log(R: ArrayLike) -> Array:
    """Return the rotation vector [3] of ``R`` [3, 3]; its length is at most pi."""
    q = quat_from_matrix(R)
    if q[0] < 0.0:
        q = -q
    s = float(np.linalg.norm(q[1:]))
    factor = 2.0 if s < 1e-12 else 2.0 * np.arctan2(s, q[0]) / s
    return factor * q[1:]


def se3_exp(xi: ArrayLike) -> Array:
    """Return the [4, 4] motion of the twist ``xi`` [6] = (v, w)."""
    xi = np.asarray(xi, np.float64)
    a, b, c = _series(float(np.linalg.norm(xi[3:])))
    W, unit = hat(xi[3:]), np.eye(3)
    W2 = W @ W
    T = np.eye(4)
    T[:3, :3] = unit + a * W + b * W2
    T[:3, 3] = (unit + b * W + c * W2) @ xi[:3]
    return T


def se3_log(T: ArrayLike) -> Array:
    """Return the twist [6] = (v, w) of the motion ``T`` [4, 4]."""
    T = np.asarray(T, np.float64)
    w = so3_log(T[:3, :3])
    _, b, c = _series(float(np.linalg.norm(w)))
    W = hat(w)
    V = np.eye(3) + b * W + c * (W @ W)
    return np.concatenate([np.linalg.solve(V, T[:3, 3]), w]).astype(np.float64)


def inverse(T: ArrayLike) -> Array:
    """Return the inverse of the rigid motion ``T`` [4, 4]."""
    T = np.asarray(T, np.float64)
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def interpolate(T_begin: ArrayLike, T_end: ArrayLike, share: float) -> Array:
    """Return the pose [4, 4] at ``share`` of the way from ``T_begin`` to ``T_end``, at a constant twist."""
    begin = np.asarray(T_begin, np.float64)
    return begin @ se3_exp(share * se3_log(inverse(begin) @ np.asarray(T_end, np.float64)))


def adjoint(T: ArrayLike) -> Array:
    """Return the [6, 6] adjoint of ``T``: Exp(Ad_T xi) = T Exp(xi) T^-1."""
    T = np.asarray(T, np.float64)
    R = T[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = hat(T[:3, 3]) @ R
    return out


def orthonormalised(T: ArrayLike) -> Array:
    """Return ``T`` [4, 4] with its rotation replaced by the nearest true rotation."""
    out = np.array(T, np.float64)
    U, _, Vt = np.linalg.svd(out[:3, :3])
    out[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return out


def quat_from_matrix(R: ArrayLike) -> Array:
    """Return the unit quaternion [4], w first, of the rotation ``R`` [3, 3]."""
    # Sums of Python's floats take a third of the time of sums of an array's elements.
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(R, np.float64).tolist()
    m = np.array(
        [
            [xx + yy + zz, 0.0, 0.0, 0.0],
            [zy - yz, xx - yy - zz, 0.0, 0.0],
            [xz - zx, xy + yx, yy - xx - zz, 0.0],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    # The largest eigenvector of Bar-Itzhack's matrix is well conditioned for every rotation.
    values, vectors = np.linalg.eigh(m / 3.0, UPLO="L")
    q = vectors[:, np.argmax(values)]
    return -q if q[0] < 0.0 else q


def matrix_from_quat(q: ArrayLike) -> Array:
    """Return the rotation [3, 3] of the quaternion ``q`` [4], w first (normalised here)."""
    return matrices_from_quats(np.asarray(q, np.float64)[None])[0]


def matrices_from_quats(quats: ArrayLike) -> Array:
    """Return [n, 3, 3] the rotations of ``quats`` [n, 4], w first (normalised here)."""
    q = np.asarray(quats, np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def transform_points(T: ArrayLike, points: ArrayLike) -> Array:
    """Return ``points`` [n, 3] moved by the rigid motion ``T`` [4, 4]."""
    T = np.asarray(T, np.float64)
    return np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3]


def rotate_quats(R: ArrayLike, quats: ArrayLike) -> Array:
    """Return ``quats`` [n, 4], w first, turned further by the rotation ``R`` [3, 3]."""
    w, x, y, z = quat_from_matrix(R)
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.asarray(quats, np.float64) @ product.T
