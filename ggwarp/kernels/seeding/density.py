# SPDX-License-Identifier: Apache-2.0
"""How many Gaussians a pixel of a keyframe is to add: by the picture's detail, and what the map lacks."""

import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.math import vec6

wp.set_module_options({"enable_backward": False})

RADIUS = wp.constant(4)
"""Of the Gaussian, one pixel in deviation, that detail is finer than."""
_TOTAL = sum(math.exp(-0.5 * k * k) for k in range(-4, 5))
_WEIGHTS = wp.constant(wp.types.vector(5, wp.float32)(*(math.exp(-0.5 * k * k) / _TOTAL for k in range(5))))


@wp.struct
class DensityRules:
    """How the density follows from what is seen; all but the share are Gaussians a pixel.

    Attributes:
        least, most: on new surface.
        detail_gain: added per unit of local colour contrast, 0..1.
        residual_gain: added per unit of colour error above ``residual_threshold``, on surface of the map.
        residual_threshold: mean absolute colour error, 0..1.
        full: a wrong colour adds none beyond that.
        tolerance: a surface is new where it is closer than the map's by more than this share of it.
    """

    least: wp.float32
    most: wp.float32
    detail_gain: wp.float32
    residual_gain: wp.float32
    residual_threshold: wp.float32
    full: wp.float32
    tolerance: wp.float32


@dataclass(frozen=True)
class SeedingWorkspace:
    """Scratch of one image size, [h, w] each.

    Attributes:
        colours, smooth_colours: vec3.
        compared: vec2, local contrast and colour error.
        density: float, Gaussians a pixel.
        chosen, numbers: int, which pixels begin a Gaussian, and how many do so up to each.
        smooth_depth: float, metres.
    """

    colours: Any
    smooth_colours: Any
    compared: Any
    density: Any
    chosen: Any
    numbers: Any
    smooth_depth: Any


def allocate_seeding(height: int, width: int, *, device: Any) -> SeedingWorkspace:
    """Return the scratch of one image size."""
    types = wp.vec3, wp.vec3, wp.vec2, wp.float32, wp.int32, wp.int32, wp.float32
    return SeedingWorkspace(*(wp.empty((height, width), dtype=t, device=device) for t in types))


@wp.func
def exposure_undone(pixels: wp.array3d[wp.uint8], row: int, column: int, exposure: vec6) -> wp.vec3:
    """The map's colours of a pixel, 0..1."""
    colour = wp.vec3()
    for c in range(3):
        value = (float(pixels[row, column, c]) / 255.0 - exposure[3 + c]) * wp.exp(-exposure[c])
        colour[c] = wp.clamp(value, 0.0, 1.0)
    return colour


@wp.func
def mirrored(i: int, size: int) -> int:
    """An index beyond the border, as the picture goes on there: mirrored about its last pixel."""
    j = wp.abs(i)
    if j >= size:
        j = 2 * (size - 1) - j
    return wp.clamp(j, 0, size - 1)


@wp.kernel
def _colours_kernel(
    pixels: wp.array3d[wp.uint8],
    exposure: wp.array[vec6],
    colours: wp.array2d[wp.vec3],
):
    row, column = wp.tid()
    colours[row, column] = exposure_undone(pixels, row, column, exposure[0])


@wp.kernel
def _smooth_kernel(colours: wp.array2d[wp.vec3], smooth: wp.array2d[wp.vec3]):
    row, column = wp.tid()
    total = _WEIGHTS[0] * colours[row, column]
    for k in range(1, RADIUS + 1):
        left = colours[row, mirrored(column - k, colours.shape[1])]
        right = colours[row, mirrored(column + k, colours.shape[1])]
        total += _WEIGHTS[k] * (left + right)
    smooth[row, column] = total


@wp.func
def _mean_difference(one: wp.vec3, other: wp.vec3) -> float:
    return (wp.abs(one[0] - other[0]) + wp.abs(one[1] - other[1]) + wp.abs(one[2] - other[2])) / 3.0


@wp.kernel
def _contrast_kernel(
    colours: wp.array2d[wp.vec3],
    smooth: wp.array2d[wp.vec3],
    image: wp.array3d[wp.float32],
    contrast_and_residual: wp.array2d[wp.vec2],
):
    row, column = wp.tid()
    total = _WEIGHTS[0] * smooth[row, column]
    for k in range(1, RADIUS + 1):
        above = smooth[mirrored(row - k, colours.shape[0]), column]
        below = smooth[mirrored(row + k, colours.shape[0]), column]
        total += _WEIGHTS[k] * (above + below)
    colour = colours[row, column]
    residual = float(0.0)
    if image:
        shown = wp.vec3(image[0, row, column], image[1, row, column], image[2, row, column])
        for c in range(3):
            shown[c] = wp.clamp(shown[c], 0.0, 1.0)
        residual = _mean_difference(shown, colour)
    contrast_and_residual[row, column] = wp.vec2(_mean_difference(colour, total), residual)


@wp.kernel
def _density_kernel(
    rules: DensityRules,
    depth: wp.array2d[wp.float32],
    contrast_and_residual: wp.array2d[wp.vec2],
    median_depth: wp.array2d[wp.float32],
    transmittance: wp.array2d[wp.float32],
    present: wp.array2d[wp.float32],
    density: wp.array2d[wp.float32],
):
    row, column = wp.tid()
    d = depth[row, column]
    out = float(0.0)
    if d > 0.0:
        total = wp.vec2()
        for i in range(-1, 2):
            for j in range(-1, 2):
                y = mirrored(row + i, depth.shape[0])
                x = mirrored(column + j, depth.shape[1])
                total += contrast_and_residual[y, x]
        mean = total / 9.0
        out = wp.clamp(rules.least + rules.detail_gain * mean[0], 0.0, rules.most)
        there = float(0.0)
        if present:
            there = present[row, column]
        fresh = wp.max(out - there, 0.0)
        out = fresh
        if median_depth:
            shown = median_depth[row, column]
            is_new = 1.0 - transmittance[row, column] < 0.5 or shown - d > rules.tolerance * shown
            if not is_new:
                more = wp.clamp(rules.residual_gain * (mean[1] - rules.residual_threshold), 0.0, rules.most)
                out = wp.min(more, wp.max(rules.full - there, 0.0))
    density[row, column] = out


def density_of_seeds(
    rules: DensityRules,
    *,
    pixels: Any,
    exposure: Any,
    depth: Any,
    image: Any,
    median_depth: Any,
    transmittance: Any,
    present: Any,
    workspace: SeedingWorkspace,
    device: Any,
) -> None:
    """Write ``workspace.density``: how many Gaussians a pixel a keyframe is to add; none without depth.

    Args:
        rules: how that follows.
        pixels: [h, w, 3] uint8, the picture.
        exposure: [1] vec6, its exposure, see :mod:`ggwarp.kernels.photometric.affine_exposure`.
        depth: [h, w] float, metres; 0 = none.
        image: [>= 3, >= h, >= w] float, the map's colours there; None: the map is empty, as are the next two.
        median_depth, transmittance: [>= h, >= w] float, of the same render.
        present: [h, w] float, Gaussians a pixel that lie on the surface already; None: none.
        workspace: of the size [h, w].
        device: a Warp device.
    """
    shape, colours = depth.shape, workspace.colours
    smooth, compared = workspace.smooth_colours, workspace.compared
    wp.launch(_colours_kernel, dim=shape, inputs=[pixels, exposure], outputs=[colours], device=device)
    wp.launch(_smooth_kernel, dim=shape, inputs=[colours], outputs=[smooth], device=device)
    wp.launch(_contrast_kernel, dim=shape, inputs=[colours, smooth, image], outputs=[compared], device=device)
    wp.launch(
        _density_kernel,
        dim=shape,
        inputs=[rules, depth, compared, median_depth, transmittance, present],
        outputs=[workspace.density],
        device=device,
    )
