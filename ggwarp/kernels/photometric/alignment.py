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
from ggwarp.kernels.math import rotation_of
from ggwarp.kernels.photometric.alignment_pixels import SUMS, add_depth, add_pixel, surface_normal, vec46
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

PIECE = 64
"""Pixels of a row, of those that count, that one thread sums."""

PARAMETERS = 8
"""tau (6), a, b."""

FOLDED = 128
"""Rows that many rows of sums are folded to first."""

_PIECE = wp.constant(PIECE)
_NEAR = wp.constant(0.05)


@wp.kernel
def _linearise(
    offset: int,
    pieces: int,
    stride: int,
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
    line = item / pieces
    piece = item - line * pieces
    row = stride / 2 + line * stride
    total = vec46()
    gain = wp.exp(exposure[0])
    begin = stride / 2 + piece * _PIECE * stride
    end = wp.min(begin + _PIECE * stride, rendered.shape[1] - 1)
    if row == 0 or row >= rendered.shape[0] - 1:
        end = begin
    rotation = rotation_of(motion)
    shift = wp.vec3(motion[0, 3], motion[1, 3], motion[2, 3])
    ray_y = (float(row) - camera.cy) / camera.fy
    step_x = 1.0 / camera.fx
    for column in range(wp.where(begin == 0, stride, begin), end, stride):
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
                total = add_pixel(
                    total, observed, seen, x, iz, u, v, camera,
                    gain, exposure[1], noise[0], noise[1], agreement,
                )  # fmt: skip
                if noise[3] > 0.0:
                    normal = surface_normal(ray_x, ray_y, right, left, down, up, camera.fx, camera.fy)
                    normal = rotation * wp.normalize(normal)
                    total = add_depth(total, observed, normal, x, u, v, camera, noise[3], noise[1])
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


def item_count(height: int, width: int, stride: int = 1) -> int:
    """Return the rows of ``sums`` that a view of this size needs where every ``stride``-th pixel counts."""
    return len(range(stride // 2, height, stride)) * _pieces(width, stride)


def _pieces(width: int, stride: int) -> int:
    return -(-len(range(stride // 2, width, stride)) // PIECE)


def linearise(
    rendered: Any,
    observed: Any,
    camera: CameraIntrinsics,
    *,
    motion: wp.mat44,
    exposure: tuple[float, float],
    noise: tuple[float, float, float, float],
    agreement: float = 0.0,
    stride: int = 1,
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
        stride: every so many-th pixel of a row and a column counts, from the ``stride // 2``-th on.
        sums: [>= item_count(h, w, stride), SUMS] float, folded: [FOLDED, SUMS] float64: scratch.
        system: [SUMS] float64, written; see :data:`SUMS`.
    """
    pieces, items = _pieces(rendered.shape[1], stride), item_count(*rendered.shape, stride)
    launch_split(
        _linearise,
        items,
        inputs=[
            pieces, stride, rendered, observed, camera, motion, wp.vec2(*exposure), wp.vec4(*noise),
            agreement,
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
