# SPDX-License-Identifier: Apache-2.0
"""Arrays that kernels write and work in, allocated once and used many times.

Launch functions allocate nothing: what they need is an argument, made here.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.identity import cross_entropy, cross_entropy_pixels, neighbour_kl
from ggwarp.kernels.losses import ssim, ssim_planes
from ggwarp.kernels.losses.pixel_lines import BAND, RowWorkspace, lines_per_row
from ggwarp.kernels.math import vec6, vec16
from ggwarp.kernels.photometric import affine_exposure
from ggwarp.kernels.raster.project import Splats
from ggwarp.kernels.raster.project_adjoint import SlotGradients
from ggwarp.kernels.raster.tiles import TileArrays, tiles_across


def _empty(size: int, dtype: Any, device: Any) -> wp.array:
    return wp.empty(size, dtype=dtype, device=device)


def allocate_splats(count: int, *, device: Any) -> Splats:
    """Allocate the projection's output for ``count`` Gaussians."""
    n = max(count, 1)
    return Splats(
        _empty(n, vec16, device), _empty(n, float, device), wp.zeros(n, dtype=wp.vec4i, device=device)
    )


def allocate_slot_gradients(slots: int, channels: int, *, device: Any) -> SlotGradients:
    """Allocate the composite adjoint's output for ``slots`` slots and 4 or 20 channels."""
    if channels not in (4, 20):
        raise ValueError(f"{channels} channels, but rendering has 4 (colour, depth) or 20 (and identity)")
    n = max(slots, 1)
    return SlotGradients(_empty(n, vec16, device), _empty(n, vec16, device) if channels == 20 else None)


def allocate_tiles(count: int, slots: int, *, width: int, height: int, device: Any) -> TileArrays:
    """Allocate the binning's arrays for ``count`` Gaussians, ``slots`` slots and an image's tiles."""
    n, slots = max(count, 1), max(slots, 1)

    def ints(size: int) -> wp.array:
        return wp.zeros(size, dtype=int, device=device)

    return TileArrays(
        visible=ints(n),
        order=ints(2 * n),
        ranks=ints(n),
        slot_offsets=ints(n + 1),
        slot_gaussians=ints(slots),
        pair_slots=ints(2 * slots),
        tile_ranges=wp.zeros(tiles_across(width) * tiles_across(height), dtype=wp.vec2i, device=device),
        counts=ints(4),
        depth_keys=_empty(2 * n, float, device),
        pair_counts=ints(n + 1),
        pair_tiles=ints(2 * slots),
    )


def allocate_loss(
    height: int, width: int, *, device: Any, by_rows: bool | None = None
) -> ssim_planes.PlaneWorkspace | RowWorkspace:
    """Allocate the scratch of the colour and depth losses for an image of ``height`` x ``width``.

    Args:
        by_rows: take the form for a CPU; the default does on the CPU alone.
    """
    if wp.get_device(device).is_cpu if by_rows is None else by_rows:
        rows, lines = -(-height // BAND) * BAND, lines_per_row(width)

        def planes(count: int, tall: int) -> Any:
            return wp.zeros((count, tall, lines), dtype=vec16, device=device)

        return RowWorkspace(
            colours=planes(7, rows),
            means=planes(12, rows + 2 * ssim.REACH),
            slopes=planes(9, rows),
            slope_means=planes(9, rows + 2 * ssim.REACH),
            partials=wp.zeros(rows, dtype=wp.vec4, device=device),
        )
    return _allocate_planes(height, width, device)


def allocate_ssim(
    height: int, width: int, *, device: Any
) -> ssim.PixelWorkspace | ssim_planes.PlaneWorkspace:
    """Allocate the scratch of SSIM alone for images of ``height`` x ``width``."""
    if not wp.get_device(device).is_cpu:
        return _allocate_planes(height, width, device)
    shape = (height + 2 * ssim.REACH, width + 2 * ssim.REACH)
    return ssim.PixelWorkspace(
        *(wp.zeros(shape, dtype=vec16, device=device) for _ in range(3)),
        partials=wp.zeros(height, dtype=wp.vec4, device=device),
    )


def _allocate_planes(height: int, width: int, device: Any) -> ssim_planes.PlaneWorkspace:
    def planes(count: int) -> Any:
        shape = (count, height + 2 * ssim.REACH, width + 2 * ssim.REACH)
        return wp.zeros(shape, dtype=float, device=device)

    partials, bins = (wp.zeros(n, dtype=wp.vec4, device=device) for n in (height * width, ssim_planes.BINS))
    return ssim_planes.PlaneWorkspace(planes(6), planes(15), planes(9), partials, bins)


def allocate_exposure(
    height: int, width: int, padded: tuple[int, int], *, device: Any
) -> affine_exposure.ExposureWorkspace:
    """Allocate the scratch of exposure for an image of ``height`` x ``width``, ``padded`` (rows, columns)."""
    row: Any = vec6
    return affine_exposure.ExposureWorkspace(
        exposed=wp.zeros((4, *padded), dtype=float, device=device),
        partials=wp.zeros(affine_exposure.items(height, width, device), dtype=row, device=device),
        bins=wp.zeros(affine_exposure.BINS, dtype=row, device=device),
    )


def allocate_identity(
    padded_height: int, padded_width: int, *, capacity: int, device: Any
) -> cross_entropy.IdentityWorkspace:
    """Allocate the scratch of the cross-entropy for a padded image and up to ``capacity`` classes."""
    by_rows = cross_entropy.runs_by_rows(device)
    bands = padded_height // int(cross_entropy_pixels.BAND_ROWS)
    items = bands if by_rows else 0
    parts = bands if by_rows else cross_entropy_pixels.partial_rows(padded_height, padded_width)
    return cross_entropy.IdentityWorkspace(
        logits=wp.zeros((items, capacity), dtype=vec16, device=device),
        bias_sums=wp.zeros((items, capacity), dtype=vec16, device=device),
        blocks=wp.zeros((items, 32), dtype=vec16, device=device),
        log_sums=wp.zeros(
            (0, 0) if by_rows else (padded_height, padded_width), dtype=wp.float32, device=device
        ),
        weight_partials=wp.zeros((parts, capacity), dtype=vec16, device=device),
        other_partials=wp.zeros((parts, capacity), dtype=wp.vec2, device=device),
        class_losses=wp.zeros(capacity, dtype=wp.float32, device=device),
    )


def allocate_neighbours(
    samples: int, neighbours: int, *, capacity: int, device: Any
) -> neighbour_kl.NeighbourWorkspace:
    """Allocate the scratch of the KL term for ``samples`` Gaussians with ``neighbours`` each."""
    slots = samples * (1 + neighbours)
    partials = (-(-slots // neighbour_kl.CHUNK), capacity)
    return neighbour_kl.NeighbourWorkspace(
        log_p=wp.zeros((slots, capacity), dtype=wp.float32, device=device),
        slot_gradients=wp.zeros(slots, dtype=vec16, device=device),
        keys=wp.zeros(2 * slots, dtype=wp.int32, device=device),
        values=wp.zeros(2 * slots, dtype=wp.int32, device=device),
        weight_partials=wp.zeros(partials, dtype=vec16, device=device),
        bias_partials=wp.zeros(partials, dtype=wp.float32, device=device),
        divergences=wp.zeros(samples, dtype=wp.float32, device=device),
    )
