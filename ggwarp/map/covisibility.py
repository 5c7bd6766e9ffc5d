# SPDX-License-Identifier: Apache-2.0
"""What a pose would see of the map: the Gaussians in view, and how far away they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.raster.covisibility import flag_seen
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float64

Seen = NDArray[np.bool_]

_OPAQUE = 0.95


@dataclass(frozen=True)
class Visibility:
    """What one pose sees.

    Attributes:
        seen: [n] bool, the Gaussians that the light reaches before half of it is taken.
        median_depth: metres, over the opaque pixels; nan where there are none.
    """

    seen: Seen
    median_depth: float


Look = Callable[[Float64], Visibility]
"""What a camera-to-world pose [4, 4] sees of the map."""


class Covisibility:
    """Looks at a map from any pose; reads the map, never writes it."""

    def __init__(self, gaussians: GaussianMap, camera: Camera) -> None:
        self._map = gaussians
        self._renderer = Renderer(gaussians, camera, identity=False)
        self._flags: Any = None

    def look(self, T_wc: Float64) -> Visibility:
        """Return what the camera at ``T_wc`` [4, 4] sees."""
        renderer, camera, count = self._renderer, self._renderer.camera, self._map.count
        if self._flags is None or self._flags.shape[0] != self._map.capacity:
            byte: Any = wp.uint8
            self._flags = wp.empty(self._map.capacity, dtype=byte, device=self._map.device)
        renderer.render(T_wc)
        flag_seen(
            renderer.splats,
            renderer.median_depth,
            width=camera.width,
            height=camera.height,
            count=count,
            flags=self._flags,
        )
        opaque = renderer.plane(renderer.transmittance) < 1.0 - _OPAQUE
        depths = renderer.plane(renderer.median_depth)[opaque]
        median = float(np.median(depths)) if depths.size else float("nan")
        return Visibility(to_host(self._flags)[:count].astype(bool), median)


def intersection_over_union(a: Seen, b: Seen) -> float:
    """Return the share of what either sees that both see; 0 where nothing is seen."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0


def overlap_coefficient(a: Seen, b: Seen) -> float:
    """Return the share of the smaller set that both see; 0 where a set is empty."""
    smaller = min(np.count_nonzero(a), np.count_nonzero(b))
    return np.count_nonzero(a & b) / smaller if smaller else 0.0
