# SPDX-License-Identifier: Apache-2.0
"""What lies under the pointer: the map is rendered along its ray, and what makes up the pixel is it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ggwarp.editing.map_view import MapView
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float64

_SIZE = 15  # pixels of the picture round the ray; its middle counts
_FOCAL = 500.0  # pixels: a picture of 1000 pixels that shows 90 degrees
_COUNTED = slice(_SIZE // 2 - 1, _SIZE // 2 + 2)
_LEAST_OPACITY = 0.3


@dataclass(frozen=True)
class Pick:
    """What a ray meets.

    Attributes:
        object_id: of the object that makes up most of what is seen; 0: it is no object's.
        point: [3] where the surface is met, metres, world frame.
    """

    object_id: int
    point: Float64


class Picker:
    """Finds what rays meet in one map."""

    def __init__(self, gaussians: Gaussians, *, device: Any = "cpu") -> None:
        """Upload ``gaussians`` to ``device``."""
        middle = (_SIZE - 1) / 2.0
        self._ids = gaussians.object_ids
        self._view = MapView(gaussians, Camera(_SIZE, _SIZE, _FOCAL, _FOCAL, middle, middle), device=device)

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Pick | None:
        """Return what the ray from ``origin`` [3] along ``direction`` [3], world frame, meets; None: nothing.

        Nine pixels round the ray are rendered, and each Gaussian's blending weight in them is counted for its
        object, as the identity image's labels are.
        """
        T_wc = looking(np.asarray(origin, np.float64), np.asarray(direction, np.float64))
        counted = np.zeros((_SIZE, _SIZE), bool)
        counted[_COUNTED, _COUNTED] = True
        seen = self._view.render(T_wc)
        if seen.opacity[counted].mean() < _LEAST_OPACITY:
            return None
        depth = float(np.median(seen.surface_depth[counted]))
        point = T_wc[:3, 3] + depth * T_wc[:3, 2]
        if self._ids is None:
            return Pick(0, point)
        weights = self._view.weights(T_wc, counted)[0]
        ids, inverse = np.unique(self._ids, return_inverse=True)
        shares = np.bincount(inverse, weights=weights, minlength=len(ids))
        return Pick(int(ids[shares.argmax()]), point)


def looking(origin: Float64, direction: Float64) -> Float64:
    """Return a camera-to-world pose [4, 4] at ``origin`` [3] whose axis is ``direction`` [3]."""
    forward = direction / np.linalg.norm(direction)
    across = np.cross(np.eye(3)[np.abs(forward).argmin()], forward)
    across /= np.linalg.norm(across)
    T_wc = np.eye(4)
    T_wc[:3, :3] = np.stack([across, np.cross(forward, across), forward], axis=1)
    T_wc[:3, 3] = origin
    return T_wc
