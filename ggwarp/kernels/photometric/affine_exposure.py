# SPDX-License-Identifier: Apache-2.0
"""Exposure of a render: y = e^a x + b by channel, its adjoint, and Adam on a and b (MonoGS section 3.3).

y is cut at 1, as a sensor does: where it is cut, the gradient passes only if it asks for less.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.math import vec6
from ggwarp.kernels.optim.adam import step_of_six
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

BINS = 256
_K_BINS = wp.constant(BINS)
_CUDA_ROWS = 16
_FINITE = wp.constant(wp.float32(1.0e30))


@dataclass(frozen=True)
class ExposureWorkspace:
    """Scratch of one image size.

    Attributes:
        exposed: [4, Hp, Wp], the render as the picture has it; plane 3 is the depth.
        partials: [:func:`items`] vec6.
        bins: [BINS] vec6.
    """

    exposed: Any
    partials: Any
    bins: Any


def items(height: int, width: int, device: Any) -> int:
    """Return into how many pieces an image is cut: rows on the CPU, columns of 16 pixels on CUDA."""
    rows, pieces = _grain(width, device)
    return -(-height // rows) * pieces


def _grain(width: int, device: Any) -> tuple[int, int]:
    """Return the rows of a band and its pieces."""
    return (1, 1) if wp.get_device(device).is_cpu else (_CUDA_ROWS, width)


@wp.func
def _gain(exposure: vec6) -> wp.vec3:
    return wp.vec3(wp.exp(exposure[0]), wp.exp(exposure[1]), wp.exp(exposure[2]))


@wp.func
def _offset(exposure: vec6) -> wp.vec3:
    return wp.vec3(exposure[3], exposure[4], exposure[5])


@wp.kernel
def _expose_kernel(
    offset: int,
    rows: int,
    pieces: int,
    height: int,
    width: int,
    exposure: wp.array[vec6],
    image: wp.array3d[wp.float32],
    exposed: wp.array3d[wp.float32],
):
    item = offset + wp.tid()
    band = item / pieces
    piece = item - band * pieces
    gain = _gain(exposure[0])
    shift = _offset(exposure[0])
    for row in range(band * rows, wp.min((band + 1) * rows, height)):
        for column in range(width * piece / pieces, width * (piece + 1) / pieces):
            for c in range(3):
                exposed[c, row, column] = wp.min(gain[c] * image[c, row, column] + shift[c], 1.0)
            exposed[3, row, column] = image[3, row, column]


@wp.kernel
def _adjoint_kernel(
    offset: int,
    rows: int,
    pieces: int,
    height: int,
    width: int,
    exposure: wp.array[vec6],
    image: wp.array3d[wp.float32],
    d_image: wp.array3d[wp.float32],
    partials: wp.array[vec6],
):
    item = offset + wp.tid()
    band = item / pieces
    piece = item - band * pieces
    gain = _gain(exposure[0])
    shift = _offset(exposure[0])
    total = vec6()
    for row in range(band * rows, wp.min((band + 1) * rows, height)):
        for column in range(width * piece / pieces, width * (piece + 1) / pieces):
            for c in range(3):
                d = d_image[c, row, column]
                y = gain[c] * image[c, row, column]
                if y + shift[c] > 1.0 and d < 0.0:
                    d = float(0.0)
                total[c] += d * y
                total[3 + c] += d
                d_image[c, row, column] = d * gain[c]
    partials[item] = total


@wp.kernel
def _fold_kernel(count: int, partials: wp.array[vec6], bins: wp.array[vec6]):
    k = wp.tid()
    total = vec6()
    for i in range(k, count, _K_BINS):
        total += partials[i]
    bins[k] = total


@wp.kernel
def _step_kernel(
    count: int,
    rate: float,
    pull: float,
    bins: wp.array[vec6],
    moments: wp.array[vec6],
    steps: wp.array[wp.int32],
    exposure: wp.array[vec6],
):
    g = pull * exposure[0]
    for k in range(count):
        g += bins[k]
    if not (wp.dot(g, g) < _FINITE):
        return
    exposure[0] = exposure[0] - step_of_six(g, vec6(rate), moments, steps)


def expose(image: Any, exposure: Any, *, height: int, width: int, exposed: Any, device: Any) -> None:
    """Write the render as a picture of this exposure has it.

    Args:
        image: [C, Hp, Wp], C >= 4; colour in planes 0-2, depth in plane 3.
        exposure: [1] vec6: a of red, green, blue, then b.
        exposed: [4, Hp, Wp]; the padding is left alone.
    """
    rows, pieces = _grain(width, device)
    launch_split(
        _expose_kernel,
        items(height, width, device),
        inputs=[rows, pieces, height, width, exposure, image],
        outputs=[exposed],
        device=device,
        min_piece=16,
    )


def expose_adjoint(
    image: Any,
    exposure: Any,
    *,
    height: int,
    width: int,
    d_image: Any,
    workspace: ExposureWorkspace,
    device: Any,
) -> None:
    """Take the gradient by the exposed image back to the render and, in sums, to the exposure.

    Args:
        image, exposure: as :func:`expose` had them.
        d_image: [C, Hp, Wp]; planes 0-2, by the exposed image, become those by the render.
        workspace: its sums are left for :func:`step_exposure`.
    """
    rows, pieces = _grain(width, device)
    count = items(height, width, device)
    launch_split(
        _adjoint_kernel,
        count,
        inputs=[rows, pieces, height, width, exposure, image],
        outputs=[d_image, workspace.partials],
        device=device,
        min_piece=16,
    )
    wp.launch(
        _fold_kernel,
        dim=BINS,
        inputs=[count, workspace.partials],
        outputs=[workspace.bins],
        device=device,
    )


def step_exposure(
    exposure: Any,
    *,
    rate: float,
    pull: float,
    moments: Any,
    steps: Any,
    workspace: ExposureWorkspace,
    device: Any,
) -> None:
    """Take one Adam step on the exposure after :func:`expose_adjoint`; one that is not finite is left out.

    Args:
        exposure: [1] vec6, updated.
        rate: units a step.
        pull: weight of |exposure|^2 / 2 in the loss.
        moments: [2] vec6; zeros at first. steps: [1] int, steps taken.
    """
    wp.launch(
        _step_kernel,
        dim=1,
        inputs=[BINS, rate, pull, workspace.bins],
        outputs=[moments, steps, exposure],
        device=device,
    )
