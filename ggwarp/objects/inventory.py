# SPDX-License-Identifier: Apache-2.0
"""The list of objects in a map."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.map.gaussians import SH_C0
from ggwarp.objects.registry import NO_OBJECT

_TRIM = 1.0  # percent: stray Gaussians must not decide a box


def inventory(
    means: NDArray[np.float32],
    colours: NDArray[np.float32],
    object_ids: NDArray[np.integer[Any]] | None,
    *,
    names: dict[int, str] | None = None,
) -> list[dict[str, Any]]:
    """Describe every object of a map.

    Args:
        means: [n, 3] Gaussians' centres, metres, world frame.
        colours: [n, 3] degree-0 spherical harmonics.
        object_ids: [n] ids as the masks name them, 0 = none; None: the map knows no objects.
        names: id -> class name, where the data gives one.

    Returns:
        One entry per object, by id: ``id``; ``count`` of Gaussians; ``box``, its ``min`` and ``max`` corners
        (metres, world axes) between the 1st and 99th percentile of its Gaussians' centres; mean ``colour``
        (RGB, 0..255); ``class``, None where unknown.
    """
    if object_ids is None or len(object_ids) == 0:
        return []
    order = np.argsort(object_ids, kind="stable")
    ids, starts = np.unique(object_ids[order], return_index=True)
    entries = []
    for identifier, members in zip(ids.tolist(), np.split(order, starts[1:]), strict=True):
        if identifier == NO_OBJECT:
            continue
        low, high = np.percentile(means[members], [_TRIM, 100.0 - _TRIM], axis=0)
        rgb = np.clip(0.5 + SH_C0 * colours[members].mean(0), 0.0, 1.0)
        entries.append(
            {
                "id": identifier,
                "count": len(members),
                "box": {"min": np.round(low, 4).tolist(), "max": np.round(high, 4).tolist()},
                "colour": np.rint(255.0 * rgb).astype(int).tolist(),
                "class": (names or {}).get(identifier),
            }
        )
    return entries
