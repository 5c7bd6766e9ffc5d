# SPDX-License-Identifier: Apache-2.0
"""Allocation of the scratch arrays that the loss kernels take as arguments."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels import ssim
from ggwarp.kernels.math import vec16


def allocate_loss(height: int, width: int, *, device: Any) -> ssim.LossWorkspace:
    """Allocate the scratch of the colour and depth losses for an image of ``height`` x ``width``."""
    shape = (height + 2 * ssim.REACH, width + 2 * ssim.REACH)
    items = height * ssim.pieces_per_row(width, device)
    return ssim.LossWorkspace(
        statistics=wp.zeros(shape, dtype=vec16, device=device),
        blurred=wp.zeros(shape, dtype=vec16, device=device),
        slopes=wp.zeros(shape, dtype=vec16, device=device),
        partials=wp.zeros(items, dtype=wp.vec4, device=device),
        bins=wp.zeros(ssim.BINS, dtype=wp.vec4, device=device),
    )
