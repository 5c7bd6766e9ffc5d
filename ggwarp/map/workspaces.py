# SPDX-License-Identifier: Apache-2.0
"""Allocation of the scratch arrays that the loss kernels take as arguments."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels import exposure, identity, identity_kl, ssim
from ggwarp.kernels.math import vec6, vec16
from ggwarp.kernels.pixel_lines import BAND, RowWorkspace, lines_per_row
from ggwarp.kernels.sampling import BAND_ROWS


def allocate_loss(
    height: int, width: int, *, device: Any, by_rows: bool | None = None
) -> ssim.LossWorkspace | RowWorkspace:
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
    shape = (height + 2 * ssim.REACH, width + 2 * ssim.REACH)
    items = height * ssim.pieces_per_row(width, device)
    return ssim.LossWorkspace(
        statistics=wp.zeros(shape, dtype=vec16, device=device),
        blurred=wp.zeros(shape, dtype=vec16, device=device),
        slopes=wp.zeros(shape, dtype=vec16, device=device),
        partials=wp.zeros(items, dtype=wp.vec4, device=device),
        bins=wp.zeros(ssim.BINS, dtype=wp.vec4, device=device),
    )


def allocate_exposure(
    height: int, width: int, padded: tuple[int, int], *, device: Any
) -> exposure.ExposureWorkspace:
    """Allocate the scratch of exposure for an image of ``height`` x ``width``, ``padded`` (rows, columns)."""
    row: Any = vec6
    return exposure.ExposureWorkspace(
        exposed=wp.zeros((4, *padded), dtype=float, device=device),
        partials=wp.zeros(exposure.items(height, width, device), dtype=row, device=device),
        bins=wp.zeros(exposure.BINS, dtype=row, device=device),
    )


def allocate_identity(
    padded_height: int, padded_width: int, *, capacity: int, device: Any
) -> identity.IdentityWorkspace:
    """Allocate the scratch of the cross-entropy for a padded image and up to ``capacity`` classes."""
    by_rows = identity.runs_by_rows(device)
    bands = padded_height // int(BAND_ROWS)
    items = bands if by_rows else 0
    return identity.IdentityWorkspace(
        logits=wp.zeros((items, capacity), dtype=vec16, device=device),
        bias_sums=wp.zeros((items, capacity), dtype=vec16, device=device),
        blocks=wp.zeros((items, 32), dtype=vec16, device=device),
        log_sums=wp.zeros(
            (0, 0) if by_rows else (padded_height, padded_width), dtype=wp.float32, device=device
        ),
        weight_partials=wp.zeros((bands, capacity), dtype=vec16, device=device),
        other_partials=wp.zeros((bands, capacity), dtype=wp.vec2, device=device),
        class_losses=wp.zeros(capacity, dtype=wp.float32, device=device),
    )


def allocate_neighbours(
    samples: int, neighbours: int, *, capacity: int, device: Any
) -> identity_kl.NeighbourWorkspace:
    """Allocate the scratch of the KL term for ``samples`` Gaussians with ``neighbours`` each."""
    slots = samples * (1 + neighbours)
    partials = (-(-slots // identity_kl.CHUNK), capacity)
    return identity_kl.NeighbourWorkspace(
        log_p=wp.zeros((slots, capacity), dtype=wp.float32, device=device),
        slot_gradients=wp.zeros(slots, dtype=vec16, device=device),
        keys=wp.zeros(2 * slots, dtype=wp.int32, device=device),
        values=wp.zeros(2 * slots, dtype=wp.int32, device=device),
        weight_partials=wp.zeros(partials, dtype=vec16, device=device),
        bias_partials=wp.zeros(partials, dtype=wp.float32, device=device),
        divergences=wp.zeros(samples, dtype=wp.float32, device=device),
    )
