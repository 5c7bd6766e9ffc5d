# SPDX-License-Identifier: Apache-2.0
"""The Gaussians that a keyframe adds: which of its pixels begin one, and what it begins as."""

from typing import Any

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import matrix_to_quat, rotation_of, transform_point, vec6, vec16
from ggwarp.kernels.seeding.density import exposure_undone, mirrored

wp.set_module_options({"enable_backward": False})

_R2 = wp.constant(wp.vec3d(0.7548776662466927, 0.5698402909980532, 0.6180339887498949))
"""Roberts' sequence over columns, rows and frames: evenly spread at every density, unlike noise."""
_REACH = wp.constant(2)
"""Pixels to each side that depth is smoothed over."""
_SPREAD2 = wp.constant(8.0)
"""Twice the variance of that by place, pixels^2..."""
_STEP2 = wp.constant(0.005)
"""... and by depth, metres^2: what lies farther off is another surface."""
_BREAK = wp.constant(0.1)
"""Depths that differ by more than this share across a pixel are two surfaces."""


@wp.struct
class SeedRules:
    """What a Gaussian begins as.

    Attributes:
        spacing: its standard deviation in units of the distance to its neighbours.
        flatness: that along the normal, in units of that.
        stretch: most that it is stretched downhill on a grazing surface.
        opacity_logit: as it says.
        colour_scale: of colours to coefficients: SH_C0.
        noise: share of noise in an identity whose class is known.
    """

    spacing: wp.float32
    flatness: wp.float32
    stretch: wp.float32
    opacity_logit: wp.float32
    colour_scale: wp.float32
    noise: wp.float32


@wp.kernel
def _choose_kernel(frame: int, density: wp.array2d[wp.float32], chosen: wp.array2d[wp.int32]):
    row, column = wp.tid()
    at = _R2[0] * wp.float64(column) + _R2[1] * wp.float64(row) + _R2[2] * wp.float64(frame)
    drawn = at - wp.floor(at) < wp.float64(density[row, column])
    chosen[row, column] = wp.where(drawn, 1, 0)


@wp.kernel
def _smooth_kernel(depth: wp.array2d[wp.float32], smooth: wp.array2d[wp.float32]):
    row, column = wp.tid()
    own = depth[row, column]
    total = float(0.0)
    weights = float(0.0)
    for i in range(-_REACH, _REACH + 1):
        for j in range(-_REACH, _REACH + 1):
            if i * i + j * j <= _REACH * _REACH:
                other = depth[mirrored(row + i, depth.shape[0]), mirrored(column + j, depth.shape[1])]
                gap = other - own
                weight = wp.exp(-float(i * i + j * j) / _SPREAD2 - gap * gap / _STEP2)
                total += weight * other
                weights += weight
    smooth[row, column] = total / weights


@wp.func
def _point(camera: CameraIntrinsics, row: int, column: int, z: float) -> wp.vec3:
    x = (float(column) - camera.cx) / camera.fx
    y = (float(row) - camera.cy) / camera.fy
    return wp.vec3(x * z, y * z, z)


@wp.func
def normal_at(
    camera: CameraIntrinsics,
    depth: wp.array2d[wp.float32],
    smooth: wp.array2d[wp.float32],
    row: int,
    column: int,
) -> wp.vec3:
    """Unit normal at a pixel, camera frame, towards the camera; 0 where it is not known."""
    right = wp.min(column + 1, depth.shape[1] - 1)
    left = wp.max(column - 1, 0)
    below = wp.min(row + 1, depth.shape[0] - 1)
    above = wp.max(row - 1, 0)
    du = _point(camera, row, right, smooth[row, right]) - _point(camera, row, left, smooth[row, left])
    dv = _point(camera, below, column, smooth[below, column]) - _point(
        camera, above, column, smooth[above, column]
    )
    normal = wp.cross(du, dv)
    length = wp.length(normal)
    # Across a depth edge the differences span two surfaces.
    reach = _BREAK * smooth[row, column]
    known = (
        wp.abs(du[2]) <= reach and wp.abs(dv[2]) <= reach and depth[row, column] > 0.0 and length > 1.0e-12
    )
    out = wp.vec3()
    if known:
        out = normal / length
        if wp.dot(out, _point(camera, row, column, 1.0)) > 0.0:
            out = -out
    return out


@wp.kernel
def _normals_kernel(
    camera: CameraIntrinsics,
    depth: wp.array2d[wp.float32],
    smooth: wp.array2d[wp.float32],
    normals: wp.array2d[wp.vec3],
):
    row, column = wp.tid()
    normals[row, column] = normal_at(camera, depth, smooth, row, column)


@wp.kernel
def _seeds_kernel(
    rules: SeedRules,
    begin: int,
    pixels: wp.array3d[wp.uint8],
    exposure: wp.array[vec6],
    depth: wp.array2d[wp.float32],
    smooth: wp.array2d[wp.float32],
    camera: CameraIntrinsics,
    T_wc: wp.array[wp.mat44],
    density: wp.array2d[wp.float32],
    present: wp.array2d[wp.float32],
    chosen: wp.array2d[wp.int32],
    numbers: wp.array2d[wp.int32],
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    colours: wp.array[wp.vec3],
):
    row, column = wp.tid()
    if chosen[row, column] == 0:
        return
    out = begin + numbers[row, column] - 1
    z = depth[row, column]
    point = _point(camera, row, column, z)
    towards = -wp.normalize(point)
    normal = normal_at(camera, depth, smooth, row, column)
    if wp.length(normal) == 0.0:
        normal = towards

    cosine = wp.clamp(wp.dot(normal, towards), 0.0, 1.0)
    downhill = towards - cosine * normal
    if wp.length(downhill) < 1.0e-3:  # seen head on, any tangent serves
        helper = wp.vec3(0.0, 1.0, 0.0)
        if wp.abs(normal[0]) < 0.9:
            helper = wp.vec3(1.0, 0.0, 0.0)
        downhill = wp.cross(normal, helper)
    downhill = wp.normalize(downhill)
    level = wp.cross(normal, downhill)
    axes = wp.matrix_from_cols(downhill, level, normal)

    total = density[row, column]
    if present:
        total += present[row, column]
    spread = rules.spacing / wp.sqrt(total) * z / camera.fx
    stretch = wp.min(1.0 / wp.max(cosine, 1.0e-3), rules.stretch)
    scales = spread * wp.vec3(stretch, 1.0, rules.flatness)
    means[out] = transform_point(T_wc[0], point)
    quats[out] = matrix_to_quat(rotation_of(T_wc[0]) * axes)
    for c in range(3):
        scales[c] = wp.log(wp.max(scales[c], 1.0e-5))
    log_scales[out] = scales
    opacity_logits[out] = rules.opacity_logit
    colour = exposure_undone(pixels, row, column, exposure[0])
    colours[out] = (colour - wp.vec3(0.5)) / rules.colour_scale


@wp.kernel
def _identities_kernel(
    rules: SeedRules,
    begin: int,
    chosen: wp.array2d[wp.int32],
    numbers: wp.array2d[wp.int32],
    seed: int,
    codes: wp.array[vec16],
    classes: wp.array2d[wp.int32],
    labels: wp.array2d[wp.int32],
    identities: wp.array[vec16],
    votes: wp.array[wp.int32],
):
    row, column = wp.tid()
    if chosen[row, column] == 0:
        return
    number = numbers[row, column] - 1
    state = wp.rand_init(seed, number)
    identity = vec16()
    for c in range(16):
        identity[c] = (wp.randf(state) - 0.5) / rules.colour_scale
    if classes:
        k = classes[row, column]
        if k >= 0 and k < codes.shape[0]:
            identity = (1.0 - rules.noise) * codes[k] + rules.noise * identity
    identities[begin + number] = identity
    if labels:
        votes[begin + number] = wp.where(labels[row, column] >= 0, 1, 0)


def choose_pixels(density: Any, *, frame: int, chosen: Any, numbers: Any, device: Any) -> None:
    """Draw pixels at ``density`` by a low-discrepancy dither, repeatably.

    Args:
        density: [h, w] float, Gaussians a pixel.
        frame: number of the frame: each has its own pattern.
        chosen: [h, w] int, written: 1 for those drawn, else 0.
        numbers: [h, w] int, written: how many are drawn up to each pixel, itself included, row by row.
        device: a Warp device.
    """
    wp.launch(_choose_kernel, dim=density.shape, inputs=[frame, density], outputs=[chosen], device=device)
    wp.utils.array_scan(chosen.flatten(), numbers.flatten(), inclusive=True)


def smoothed_depth(depth: Any, *, smooth: Any, device: Any) -> None:
    """Smooth ``depth`` [h, w], metres, 0 = none, into ``smooth`` [h, w], edges kept (bilateral filter)."""
    wp.launch(_smooth_kernel, dim=depth.shape, inputs=[depth], outputs=[smooth], device=device)


def surface_normals(depth: Any, *, smooth: Any, camera: CameraIntrinsics, normals: Any, device: Any) -> None:
    """Write unit normals, camera frame, towards the camera; 0 where they are not known.

    Args:
        depth, smooth: [h, w] float, metres, 0 = none, as it is and smoothed.
        normals: [h, w] vec3, written.
        device: a Warp device.
    """
    wp.launch(
        _normals_kernel, dim=depth.shape, inputs=[camera, depth, smooth], outputs=[normals], device=device
    )


def begin_gaussians(
    rules: SeedRules,
    *,
    begin: int,
    pixels: Any,
    exposure: Any,
    depth: Any,
    smooth: Any,
    camera: CameraIntrinsics,
    T_wc: Any,
    density: Any,
    present: Any,
    chosen: Any,
    numbers: Any,
    outputs: dict[str, Any],
    device: Any,
) -> None:
    """Write the Gaussians of the chosen pixels into rows ``begin`` on, row by row of the picture.

    Args:
        rules: what they begin as.
        pixels, exposure: as of :func:`ggwarp.kernels.seeding.density.density_of_seeds`.
        depth, smooth: [h, w] float, metres, 0 = none, as it is and smoothed.
        T_wc: [1] mat44, camera to world.
        density, present: [h, w] float, new Gaussians a pixel, and those there already, or None.
        chosen, numbers: of :func:`choose_pixels`.
        outputs: means, quats, log_scales, opacity_logits and colours, the map's.
        device: a Warp device.
    """
    names = ("means", "quats", "log_scales", "opacity_logits", "colours")
    wp.launch(
        _seeds_kernel,
        dim=depth.shape,
        inputs=[
            rules, begin, pixels, exposure, depth, smooth, camera, T_wc, density, present, chosen, numbers,
        ],
        outputs=[outputs[name] for name in names],
        device=device,
    )  # fmt: skip


def begin_identities(
    rules: SeedRules,
    *,
    begin: int,
    chosen: Any,
    numbers: Any,
    seed: int,
    codes: Any,
    classes: Any,
    labels: Any,
    identities: Any,
    votes: Any,
    device: Any,
) -> None:
    """Write the identities and the votes of those Gaussians.

    Args:
        rules, begin, chosen, numbers: as of :func:`begin_gaussians`.
        seed: of the random identities (GG-SLAM eq. 2), any int32.
        codes: [classes] vec16, the identity of each class.
        classes: [h, w] int, the class that begins at each pixel, negative: not known; None: none is.
        labels: [h, w] int, what each pixel votes for, negative: nothing; None: none votes.
        identities, votes: the map's.
        device: a Warp device.
    """
    wp.launch(
        _identities_kernel,
        dim=chosen.shape,
        inputs=[rules, begin, chosen, numbers, seed, codes, classes, labels],
        outputs=[identities, votes],
        device=device,
    )
