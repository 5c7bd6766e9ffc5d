# SPDX-License-Identifier: Apache-2.0
"""Arrays that rendering works in: allocated once, used many times."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.math import vec16
from ggwarp.kernels.project import Splats
from ggwarp.kernels.project_adjoint import SlotGradients
from ggwarp.kernels.tiles import TileArrays, tiles_across


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
