# SPDX-License-Identifier: Apache-2.0
"""What a pixel adds to the normal equations of :mod:`ggwarp.kernels.photometric.alignment`."""

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import vec6

wp.set_module_options({"enable_backward": False})

SUMS = 46
"""Numbers of a system: 36 of the upper triangle of H by rows, 8 of the gradient, the robust cost of colour,
the pixels whose colour is compared."""

_PIXEL_NOISE = 0.01
"""Standard deviation of a picture's colour, 0..1: a camera's noise and JPEG's."""

_LEAST_GRADIENT2 = wp.constant(12.0 * _PIXEL_NOISE**2)
vec46 = wp.types.vector(SUMS, wp.float32)


@wp.func
def _lift(u: float, v: float, z: float, camera: CameraIntrinsics):
    return wp.vec3((u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z)


@wp.func
def surface_normal(
    u: float, v: float, right: float, left: float, down: float, up: float, fx: float, fy: float
):
    """Return the normal, of any length, of the surface at depths beside a pixel's ray (u, v, 1).

    A pixel's ray is 1 / fx or 1 / fy from its neighbour's.
    """
    across = wp.vec3(u * (right - left) + (right + left) / fx, v * (right - left), right - left)
    along = wp.vec3(u * (down - up), v * (down - up) + (down + up) / fy, down - up)
    return wp.cross(across, along)


@wp.func
def _robust(e2: float, scale: float):
    """Weight and cost of Geman-McClure's rho(x) = x / (1 + x / scale^2)."""
    share = scale * scale / (scale * scale + e2)
    return share * share, e2 * share


@wp.func
def _add_rows(total: vec46, P: vec6, Q: vec6, U: vec6, V: vec6, w: float) -> vec46:
    """Add w (U P^T + V Q^T) to the pose's block, which is symmetric."""
    k = int(0)
    for i in range(6):
        for j in range(i, 6):
            total[k] += w * (U[i] * P[j] + V[i] * Q[j])
            k += 1
        k += 2
    return total


@wp.func
def _add_row(total: vec46, N: vec6, w: float) -> vec46:
    """Add w N N^T to the pose's block."""
    k = int(0)
    for i in range(6):
        wn = w * N[i]
        for j in range(i, 6):
            total[k] += wn * N[j]
            k += 1
        k += 2
    return total


@wp.func
def _twist(x: wp.vec3, q: wp.vec3) -> vec6:
    """Derivative of q . x by tau."""
    m = wp.cross(x, q)
    return vec6(q[0], q[1], q[2], m[0], m[1], m[2])


@wp.func
def add_pixel(
    total: vec46,
    observed: wp.array2d[wp.vec4],
    seen: wp.vec4,
    x: wp.vec3,
    iz: float,
    u: float,
    v: float,
    camera: CameraIntrinsics,
    gain: float,
    bias: float,
    noise: float,
    robust: float,
    agreement: float,
) -> vec46:
    """Add the colours of a pixel of the rendered view, where they are compared.

    Args:
        seen: its colour and depth.
        x, iz, u, v: its point in the observing camera's frame, 1 / x_z, and the pixel where it appears.
        gain, bias: e^a and b. noise, robust, agreement: see ``alignment.AlignmentProblem``.
    """
    inside = u >= 0.0 and v >= 0.0 and u < float(observed.shape[1] - 1) and v < float(observed.shape[0] - 1)
    if inside and agreement > 0.0:
        z = observed[int(v + 0.5), int(u + 0.5)][3]
        inside = z > 0.0 and wp.abs(z - x[2]) <= agreement * x[2]
    if inside:
        j = int(u)
        i = int(v)
        s = u - float(j)
        t = v - float(i)
        a = observed[i, j]
        b = observed[i, j + 1]
        c = observed[i + 1, j]
        d = observed[i + 1, j + 1]
        across = wp.lerp(b - a, d - c, t)
        down = wp.lerp(c - a, d - b, s)
        # The fourth channel is depth.
        across[3] = 0.0
        down[3] = 0.0
        if agreement > 0.0 and wp.dot(across, across) + wp.dot(down, down) < _LEAST_GRADIENT2:
            return total
        across = camera.fx * iz * across
        down = camera.fy * iz * down
        bright = gain * seen
        error = bright + wp.vec4(bias) - wp.lerp(wp.lerp(a, b, s), wp.lerp(c, d, s), t)
        bright[3] = 0.0
        error[3] = 0.0
        precision = 1.0 / (noise * noise)
        weight, cost = _robust(wp.dot(error, error) * precision, robust)
        w = weight * precision
        # The colours share the pixel's motion: the pose's block is of rank two.
        a0 = x[0] * iz
        b0 = x[1] * iz
        # -d (x, y) / d tau, times z.
        U = vec6(-1.0, 0.0, a0, x[1] * a0, -x[2] - x[0] * a0, x[1])
        V = vec6(0.0, -1.0, b0, x[2] + x[1] * b0, -x[0] * b0, -x[0])
        uv = wp.dot(across, down)
        total = _add_rows(
            total, wp.dot(across, across) * U + uv * V, uv * U + wp.dot(down, down) * V, U, V, w
        )
        by_gain = wp.dot(across, bright) * U + wp.dot(down, bright) * V
        by_bias = (across[0] + across[1] + across[2]) * U + (down[0] + down[1] + down[2]) * V
        by_error = wp.dot(across, error) * U + wp.dot(down, error) * V
        k = int(6)
        for r in range(6):
            total[k] += w * by_gain[r]
            total[k + 1] += w * by_bias[r]
            total[36 + r] += w * by_error[r]
            k += 7 - r
        total[33] += w * wp.dot(bright, bright)
        total[34] += w * (bright[0] + bright[1] + bright[2])
        total[35] += w * 3.0
        total[42] += w * wp.dot(bright, error)
        total[43] += w * (error[0] + error[1] + error[2])
        total[44] += cost
        total[45] += 1.0
    return total


@wp.func
def add_depth(
    total: vec46,
    observed: wp.array2d[wp.vec4],
    normal: wp.vec3,
    x: wp.vec3,
    u: float,
    v: float,
    camera: CameraIntrinsics,
    noise: float,
    robust: float,
) -> vec46:
    """Add the depth reading nearest to (u, v), where the point x of a surface with ``normal`` appears."""
    inside = u > -0.5 and v > -0.5
    inside = inside and u < float(observed.shape[1]) - 0.5 and v < float(observed.shape[0]) - 0.5
    if inside:
        j = int(u + 0.5)
        i = int(v + 0.5)
        z = observed[i, j][3]
        if z > 0.0:
            error = wp.dot(normal, _lift(float(j), float(i), z, camera) - x)
            precision = 1.0 / (noise * noise)
            weight, _cost = _robust(error * error * precision, robust)
            w = weight * precision
            N = -_twist(x, normal)
            total = _add_row(total, N, w)
            for r in range(6):
                total[36 + r] += w * error * N[r]
    return total
