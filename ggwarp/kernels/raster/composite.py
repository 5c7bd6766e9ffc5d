# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing of projected Gaussians, tile by tile, and its adjoint.

Of each pixel, front to back: alpha_i = min(0.99, o_i exp(-(a dx^2 + c dy^2) / 2 - b dx dy)), skipped
where under 1/255; w_i = alpha_i T_i, T_(i+1) = T_i - w_i, until T < 1e-4. Channels are sum w_i f_i on
black; the depth (channel 3) of a splat at the pixel is f_i + slope_i . (dx, dy). A clamped alpha passes no
gradient to the splat's shape and opacity, as in 3-D Gaussian Splatting.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.raster import (
    composite_cpu,
    composite_cpu_adjoint,
    composite_cuda,
    composite_cuda_adjoint,
)
from ggwarp.kernels.raster.composite_patches import TILES
from ggwarp.kernels.raster.project import Splats
from ggwarp.kernels.raster.project_adjoint import SlotGradients
from ggwarp.kernels.raster.sampling import Sample
from ggwarp.kernels.raster.tiles import TileArrays, tiles_across
from ggwarp.runtime.launch import launch_split

_MIN_TASKS = 2
"""Fewer CPU tasks than this are not worth a second thread."""


def composite(
    splats: Splats,
    tiles: TileArrays,
    *,
    width: int,
    height: int,
    image: wp.array,
    transmittance: wp.array,
    median_depth: wp.array,
    identities: wp.array | None = None,
    sample: Sample | None = None,
    cooperative: bool | None = None,
) -> None:
    """Blend binned splats into planar images, each padded to whole tiles.

    Args:
        splats: the projection.
        tiles: its binning.
        width, height: image size, pixels.
        image: [C, Hp, Wp] out.
        transmittance: [Hp, Wp] out: what is left of a ray behind all splats.
        median_depth: [Hp, Wp] out: depth at the pixel of the first splat after which T < 0.5, metres; 0
            where none.
        identities: [n] vec16 of the Gaussians, blended as channels 4 to 19; with None, C is 4.
        sample: where identities are blended; elsewhere these channels are left as they are. None: everywhere.
        cooperative: take the form for CUDA; the default does on CUDA alone. On the CPU that form needs
            ``wp.config.enable_cpu_blocks`` and is slow: it is for tests.

    Raises:
        ValueError: the channels or the padded size do not fit.
    """
    channels = _check(identities, image, width, height)
    inputs = [
        tiles_across(width),
        tiles.pair_slots,
        tiles.slot_gaussians,
        tiles.tile_ranges,
        splats.rows,
        *_identity_inputs(identities, sample),
    ]
    kernels = (composite_cpu.forward, _forms(composite_cuda.FORWARD, channels, sample))
    _launch(kernels, tiles, inputs, [image, transmittance, median_depth], cooperative)


def composite_adjoint(
    splats: Splats,
    tiles: TileArrays,
    *,
    image: wp.array,
    transmittance: wp.array,
    d_image: wp.array,
    d_transmittance: wp.array,
    out: SlotGradients,
    identities: wp.array | None = None,
    sample: Sample | None = None,
    identity_shapes: bool = True,
    cooperative: bool | None = None,
) -> None:
    """Chain the gradients of :func:`composite`'s images to every slot's splat.

    Args:
        splats, tiles, image, transmittance: what the forward pass read and wrote.
        d_image: [C, Hp, Wp], zero in the padding.
        d_transmittance: [Hp, Wp], zero in the padding.
        out: written for every slot of ``tiles``, zeros where nothing was seen.
        identities: as in :func:`composite`.
        sample: as in :func:`composite`, and the same; elsewhere the identity channels have no gradient,
            whatever d_image says.
        identity_shapes: False keeps the gradient of the identity channels from what shapes the splats
            (means, conics, opacities, slopes): it reaches ``out.identities`` alone.
        cooperative: as in :func:`composite`.

    Raises:
        ValueError: the channels or the padded size do not fit.
    """
    channels = _check(identities, image, image.shape[2], image.shape[1])
    inputs = [
        tiles_across(image.shape[2]),
        tiles.pair_slots,
        tiles.slot_gaussians,
        tiles.tile_ranges,
        splats.rows,
        *_identity_inputs(identities, sample),
        image,
        transmittance,
        d_image,
        d_transmittance,
        int(identity_shapes),
    ]
    kernels = (composite_cpu_adjoint.adjoint, _forms(composite_cuda_adjoint.ADJOINT, channels, sample))
    _launch(kernels, tiles, inputs, [out.rows, out.identities], cooperative)


def _identity_inputs(identities: wp.array | None, sample: Sample | None) -> list[Any]:
    if identities is None:
        return [None, 0, None]
    return [identities, 1, None] if sample is None else [identities, sample.stride, sample.phase]


def _forms(kernels: dict[int, Any], channels: int, sample: Sample | None) -> list[Any]:
    """Return what to launch for CUDA: with a sample, a kernel for its tiles and one for the others."""
    return list(kernels.values()) if channels == 20 and sample is not None else [kernels[channels]]


def _launch(
    kernels: tuple[Any, list[Any]],
    tiles: TileArrays,
    inputs: list[Any],
    outputs: list[Any],
    cooperative: bool | None,
) -> None:
    """Launch the form for a CPU or the one for CUDA over all tiles."""
    on_cpu, per_block = kernels
    device = outputs[0].device
    count = tiles.tile_ranges.shape[0]
    if cooperative if cooperative is not None else not device.is_cpu:
        for kernel in per_block:
            wp.launch_tiled(
                kernel,
                dim=count,
                inputs=inputs,
                outputs=outputs,
                block_dim=composite_cuda.BLOCK,
                device=device,
            )
    else:
        tasks = -(-count // TILES)
        launch_split(on_cpu, tasks, inputs=inputs, outputs=outputs, device=device, min_piece=_MIN_TASKS)


def _check(identities: wp.array | None, image: wp.array, width: int, height: int) -> int:
    """Return the number of channels."""
    channels = 4 if identities is None else 20
    needed = (channels, 16 * tiles_across(height), 16 * tiles_across(width))
    if image.shape != needed:
        raise ValueError(f"image: {image.shape}, but {needed} is needed")
    return channels
