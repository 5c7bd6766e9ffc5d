# SPDX-License-Identifier: Apache-2.0
"""Dropping rows of the map's arrays: allocates around ``kernels.compact``."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.optim import compact
from ggwarp.runtime.streams import to_host


def kept_indices(flags: Any, count: int) -> tuple[int, Any]:
    """Return how many of the first ``count`` flags are 1, and their row numbers in order.

    Args:
        flags: [>= count] int, 1 = keep, 0 = drop.
        count: rows in use.

    Returns:
        The number kept (waits for the device), and [count] int row numbers, rubbish after those.
    """
    dtype: Any = wp.int32
    positions, indices = (wp.empty(count, dtype=dtype, device=flags.device) for _ in range(2))
    if count == 0:
        return 0, indices
    compact.index_kept(flags[:count], positions=positions, indices=indices, device=flags.device)
    return int(to_host(positions[count - 1 :])[0]), indices


def gathered(array: Any, indices: Any, kept: int, *, room: int | None = None) -> Any:
    """Return a new array that begins with rows ``indices[:kept]`` of ``array``, the others zeros.

    Args:
        room: rows of it; None: as many as ``array`` has.
    """
    out = wp.zeros(array.shape[0] if room is None else room, dtype=array.dtype, device=array.device)
    compact.gather_rows(array, indices, count=kept, out=out, device=array.device)
    return out
