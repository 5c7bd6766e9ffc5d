# SPDX-License-Identifier: Apache-2.0
"""Direct alignment of a camera image to a rendered view: residuals and their normal equations.

Both are levels of a pyramid (``image_pyramid``). A pixel p of the rendered view, lifted by its depth to x in
the observing camera, is compared with what is seen there:

    r_c = e^a I_c(p) + b - O_c(pi(x)),        r_d = n . (y - x)

for each colour c, with exposure (a, b), and for the depth reading y nearest to x, against the rendered
surface's normal n. Colour may be left out where the reading nearest to pi(x) is of another surface: p is
hidden there, or was never what it seems. So is then what is flat: a gradient of no more than the noise of two
pixels, in three colours and both directions, would hold the camera where it is.

T_cw <- Exp(tau) T_cw, tau = (v, w), moves x by v + w x x. Standard deviations and Geman-McClure's kernel
weigh both. Sums go piece of a row -> system in a fixed order.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import rotation_of, vec6
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

PIECE = 64
"""Pixels of a row that one thread sums."""

PARAMETERS = 8
"""tau (6), a, b."""

SUMS = 46
"""Numbers of a system: 36 of the upper triangle of H by rows, 8 of the gradient, the robust cost of colour,
the pixels whose colour is compared."""

FOLDED = 128
"""Rows that many rows of sums are folded to first."""

_PIXEL_NOISE = 0.01
"""Standard deviation of a picture's colour, 0..1: a camera's noise and JPEG's."""

_PIECE = wp.constant(PIECE)
_LEAST_GRADIENT2 = wp.constant(12.0 * _PIXEL_NOISE**2)
vec46 = wp.types.vector(SUMS, wp.float32)
_NEAR = wp.constant(0.05)


@wp.func
def _lift(u: float, v: float, z: float, camera: CameraIntrinsics):
    return wp.vec3((u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z)


@wp.func
def _normal(u: float, v: float, right: float, left: float, down: float, up: float, fx: float, fy: float):
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
def _add_pixel(
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
def _add_depth(
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


@wp.kernel
def _linearise(
    offset: int,
    pieces: int,
    rendered: wp.array2d[wp.vec4],
    observed: wp.array2d[wp.vec4],
    camera: CameraIntrinsics,
    motion: wp.mat44,
    exposure: wp.vec2,
    noise: wp.vec4,
    agreement: float,
    sums: wp.array2d[float],
):
    item = offset + wp.tid()
    row = item / pieces
    piece = item - row * pieces
    total = vec46()
    gain = wp.exp(exposure[0])
    begin = wp.max(piece * _PIECE, 1)
    end = wp.min((piece + 1) * _PIECE, rendered.shape[1] - 1)
    if row == 0 or row == rendered.shape[0] - 1:
        end = begin
    rotation = rotation_of(motion)
    shift = wp.vec3(motion[0, 3], motion[1, 3], motion[2, 3])
    ray_y = (float(row) - camera.cy) / camera.fy
    step_x = 1.0 / camera.fx
    for column in range(begin, end):
        seen = rendered[row, column]
        z = seen[3]
        jump = noise[2] * z
        left = rendered[row, column - 1][3]
        right = rendered[row, column + 1][3]
        up = rendered[row - 1, column][3]
        down = rendered[row + 1, column][3]
        # The surface goes on to all four neighbours.
        flat = z > 0.0 and wp.abs(left - z) <= jump and wp.abs(right - z) <= jump
        if flat and wp.abs(up - z) <= jump and wp.abs(down - z) <= jump:
            ray_x = (float(column) - camera.cx) * step_x
            x = rotation * wp.vec3(ray_x * z, ray_y * z, z) + shift
            if x[2] > _NEAR:
                iz = 1.0 / x[2]
                u = camera.fx * x[0] * iz + camera.cx
                v = camera.fy * x[1] * iz + camera.cy
                total = _add_pixel(
                    total,
                    observed,
                    seen,
                    x,
                    iz,
                    u,
                    v,
                    camera,
                    gain,
                    exposure[1],
                    noise[0],
                    noise[1],
                    agreement,
                )
                if noise[3] > 0.0:
                    normal = _normal(ray_x, ray_y, right, left, down, up, camera.fx, camera.fy)
                    normal = rotation * wp.normalize(normal)
                    total = _add_depth(total, observed, normal, x, u, v, camera, noise[3], noise[1])
    for k in range(46):
        sums[item, k] = total[k]


@wp.kernel
def _fold(sums: wp.array2d[float], items: int, folded: wp.array2d[wp.float64]):
    """Row f of ``folded``: the sum of rows f, f + F, ... of ``sums``, F being the rows of ``folded``."""
    f, k = wp.tid()
    total = wp.float64(0.0)
    for item in range(f, items, folded.shape[0]):
        total += wp.float64(sums[item, k])
    folded[f, k] = total


@wp.kernel
def _add(folded: wp.array2d[wp.float64], system: wp.array[wp.float64]):
    k = wp.tid()
    total = wp.float64(0.0)
    for f in range(folded.shape[0]):
        total += folded[f, k]
    system[k] = total


@wp.kernel
def _reduce(sums: wp.array2d[float], items: int, system: wp.array[wp.float64]):
    k = wp.tid()
    total = wp.float64(0.0)
    for item in range(items):
        total += wp.float64(sums[item, k])
    system[k] = total


def folds(items: int, device: Any) -> bool:
    """Return whether rows are added in two steps: where many threads would wait for few."""
    return items > 2 * FOLDED and not wp.get_device(device).is_cpu


def item_count(height: int, width: int) -> int:
    """Return the rows of ``sums`` that a view of this size needs."""
    return height * -(-width // PIECE)


def linearise(
    rendered: Any,
    observed: Any,
    camera: CameraIntrinsics,
    *,
    motion: wp.mat44,
    exposure: tuple[float, float],
    noise: tuple[float, float, float, float],
    agreement: float = 0.0,
    sums: Any,
    folded: Any,
    system: Any,
    device: Any,
) -> None:
    """Sum the normal equations of all residuals, at robust weights.

    Args:
        rendered, observed: [h, w] vec4 views of the same size and camera.
        motion: rendering camera to observing camera.
        exposure: (a, b).
        noise: standard deviation of a colour, 0..1; deviations at which the robust kernel halves a residual's
            share of the cost; relative jump of depth within a pixel that makes an edge; standard deviation of
            depth, metres, 0 where depth is not compared.
        agreement: colour is compared where the observed depth differs by no more than this share of the
            expected one, and the picture is not flat; 0: everywhere.
        sums: [>= item_count(h, w), SUMS] float, folded: [FOLDED, SUMS] float64: scratch.
        system: [SUMS] float64, written; see :data:`SUMS`.
    """
    pieces = -(-rendered.shape[1] // PIECE)
    items = item_count(*rendered.shape)
    launch_split(
        _linearise,
        items,
        inputs=[
            pieces, rendered, observed, camera, motion, wp.vec2(*exposure), wp.vec4(*noise), agreement,
        ],
        outputs=[sums],
        device=device,
        min_piece=32,
    )  # fmt: skip
    if folds(items, device):
        wp.launch(_fold, dim=folded.shape, inputs=[sums, items], outputs=[folded], device=device)
        wp.launch(_add, dim=SUMS, inputs=[folded], outputs=[system], device=device)
    else:
        wp.launch(_reduce, dim=SUMS, inputs=[sums, items], outputs=[system], device=device)
