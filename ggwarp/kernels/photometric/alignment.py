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

from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import mat66d
from ggwarp.kernels.photometric.alignment_pixels import SUMS, add_depth, add_pixel, surface_normal, vec46
from ggwarp.kernels.rigid import rotation_d, single_matrix, translation_d
from ggwarp.runtime.launch import Work, in_turn, prepared, prepared_split

# A picture is some thousand pieces, a thread each, with two hundred registers: small blocks reach more cores.
wp.set_module_options({"enable_backward": False, "block_dim": 64})

PARAMETERS = 8
"""tau (6), a, b."""

FOLDED = 128
"""Rows that many rows of sums are folded to first."""

_NEAR = wp.constant(0.05)


@wp.struct
class AlignmentProblem:
    """What is compared, and what is known beforehand.

    Attributes:
        colour_noise, depth_noise: standard deviations of a colour, 0..1, and of a depth, metres; depth is not
            compared where that is 0.
        robust_scale: deviations at which the robust kernel halves a residual's share of the cost.
        edge: relative jump of depth within a pixel that makes an edge.
        agreement: colour is compared where the observed depth differs by no more than this share of the
            expected one, and the picture is not flat; 0: everywhere.
        fit_exposure: whether (a, b) are searched; 0: they stay.
        information: inverse covariance of tau in T_cw <- Exp(tau) T_cw, 0 where nothing is known.
        known: camera to world, the pose that it is about.
    """

    colour_noise: float
    depth_noise: float
    robust_scale: float
    edge: float
    agreement: float
    fit_exposure: int
    information: mat66d
    known: wp.mat44d


@wp.struct
class AlignmentView:
    """A reference as rendered, and the picture that is compared with it, both [h, w] and of one camera."""

    rendered: wp.array2d[wp.vec4]
    observed: wp.array2d[wp.vec4]


@dataclass(frozen=True)
class AlignmentSize:
    """Pictures of one size, as they are compared.

    Attributes:
        camera: the device's struct; height, width: its picture's.
        stride: every so many-th pixel of a row and a column counts, from the ``stride // 2``-th on.
        piece: pixels of a row, of those that count, that one thread sums; see :func:`piece_length`.
    """

    camera: CameraIntrinsics
    height: int
    width: int
    stride: int = 1
    piece: int = 64

    @property
    def pieces(self) -> int:
        """Pieces of a row."""
        return -(-len(range(self.stride // 2, self.width, self.stride)) // self.piece)

    @property
    def items(self) -> int:
        """Rows of sums that one reference needs."""
        return len(range(self.stride // 2, self.height, self.stride)) * self.pieces


@dataclass(frozen=True)
class AlignmentArrays:
    """What an alignment of one picture to R references works on.

    Attributes:
        problem: [1] :class:`AlignmentProblem`.
        views: [sizes, R] :class:`AlignmentView`, finest first.
        origins: [R] wp.mat44d, camera to world, the references' poses.
        T_cw: [1] wp.mat44d, world to camera, the picture's, improved.
        exposures: [R] wp.vec2d, (a, b), improved.
        systems: [R, SUMS] float64, the last linearisation; see :data:`SUMS`.
        state: [STATES] int, see :mod:`ggwarp.kernels.photometric.alignment_loop`.
        sums: [>= R items, SUMS] float and folded: [R, FOLDED, SUMS] float64: scratch.
    """

    problem: Any
    views: Any
    origins: Any
    T_cw: Any
    exposures: Any
    systems: Any
    state: Any
    sums: Any
    folded: Any


@wp.kernel
def _linearise(
    offset: int,
    items: int,
    pieces: int,
    length: int,
    stride: int,
    size: int,
    camera: CameraIntrinsics,
    problems: wp.array[AlignmentProblem],
    views: wp.array2d[AlignmentView],
    origins: wp.array[wp.mat44d],
    T_cw: wp.array[wp.mat44d],
    exposures: wp.array[wp.vec2d],
    sums: wp.array2d[float],
):
    item = offset + wp.tid()
    reference = item / items
    line = (item - reference * items) / pieces
    piece = item - reference * items - line * pieces
    problem = problems[0]
    rendered = views[size, reference].rendered
    observed = views[size, reference].observed
    motion = T_cw[0] * origins[reference]
    rotation = single_matrix(rotation_d(motion))
    shift = wp.vec3(translation_d(motion))
    gain = wp.exp(float(exposures[reference][0]))
    bias = float(exposures[reference][1])
    row = stride / 2 + line * stride
    total = vec46()
    begin = stride / 2 + piece * length * stride
    end = wp.min(begin + length * stride, rendered.shape[1] - 1)
    if row == 0 or row >= rendered.shape[0] - 1:
        end = begin
    ray_y = (float(row) - camera.cy) / camera.fy
    step_x = 1.0 / camera.fx
    for column in range(wp.where(begin == 0, stride, begin), end, stride):
        seen = rendered[row, column]
        z = seen[3]
        jump = problem.edge * z
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
                    gain, bias, problem.colour_noise, problem.robust_scale, problem.agreement,
                )  # fmt: skip
                if problem.depth_noise > 0.0:
                    normal = surface_normal(ray_x, ray_y, right, left, down, up, camera.fx, camera.fy)
                    normal = rotation * wp.normalize(normal)
                    total = add_depth(
                        total, observed, normal, x, u, v, camera, problem.depth_noise, problem.robust_scale
                    )
    for k in range(46):
        sums[item, k] = total[k]


@wp.kernel
def _fold(sums: wp.array2d[float], items: int, folded: wp.array3d[wp.float64]):
    """Row f of a reference: the sum of its rows f, f + F, ... of ``sums``, F being the rows there are."""
    reference, f, k = wp.tid()
    total = wp.float64(0.0)
    for item in range(reference * items + f, (reference + 1) * items, folded.shape[1]):
        total += wp.float64(sums[item, k])
    folded[reference, f, k] = total


@wp.kernel
def _add(folded: wp.array3d[wp.float64], systems: wp.array2d[wp.float64]):
    reference, k = wp.tid()
    total = wp.float64(0.0)
    for f in range(folded.shape[1]):
        total += folded[reference, f, k]
    systems[reference, k] = total


@wp.kernel
def _reduce(sums: wp.array2d[float], items: int, systems: wp.array2d[wp.float64]):
    reference, k = wp.tid()
    total = wp.float64(0.0)
    for item in range(reference * items, (reference + 1) * items):
        total += wp.float64(sums[item, k])
    systems[reference, k] = total


def piece_length(device: Any) -> int:
    """Return how many pixels of a row one thread sums: on a CPU a whole row, as there is less to add then.

    On CUDA few: 20,000 pixels are 2,500 threads then, and their chain is short.
    """
    return 256 if wp.get_device(device).is_cpu else 8


def folds(items: int, device: Any) -> bool:
    """Return whether rows are added in two steps: where many threads would wait for few."""
    return items > 2 * FOLDED and not wp.get_device(device).is_cpu


def linearisation(
    arrays: AlignmentArrays, *, level: int, size: AlignmentSize, references: int, device: Any
) -> Work:
    """Return what sums each reference's normal equations of all residuals, at robust weights, to ``systems``.

    Args:
        level: the size's place in ``views``.
        references: how many there are: the first rows.
    """
    a, items, shape = arrays, size.items, (references, SUMS)
    residuals = prepared_split(
        _linearise,
        references * items,
        inputs=[
            items, size.pieces, size.piece, size.stride, level, size.camera,
            a.problem, a.views, a.origins, a.T_cw, a.exposures,
        ],
        outputs=[a.sums],
        device=device,
        min_piece=32,
    )  # fmt: skip
    rows = [a.sums, items]
    if not folds(items, device):
        return in_turn(residuals, prepared(_reduce, shape, inputs=rows, outputs=[a.systems], device=device))
    return in_turn(
        residuals,
        prepared(_fold, (references, FOLDED, SUMS), inputs=rows, outputs=[a.folded], device=device),
        prepared(_add, shape, inputs=[a.folded], outputs=[a.systems], device=device),
    )
