# SPDX-License-Identifier: Apache-2.0
"""The camera's pose by gradient descent through the renderer, as MonoGS does it, with its values."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.kernels.math import vec6
from ggwarp.kernels.optim.pose_adam import step_pose
from ggwarp.kernels.photometric.tracking_loss import (
    FOLDED,
    photometric_loss,
    pieces_per_row,
    step_exposure,
)
from ggwarp.map.renderer import Renderer
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float64, Frame

_PATCH = 32
_DARK = 2
"""Pixels no brighter than this in any channel are not compared, of 255."""


_ITERATIONS = 100
"""Renders at most."""

_RATES = (1e-3, 3e-3)
"""Adam's rates of translation and rotation, metres and radians."""

_EXPOSURE_RATE = 1e-2
"""Adam's rate of the exposure's (a, b)."""

_TOLERANCE = 1e-4
"""Done when a step is smaller, metres and radians."""

_DEPTH_WEIGHT = 0.05
"""Share of the depth's error in the loss, where there is depth."""

_EDGE = 1.1
"""Colours are compared where the picture changes by more than this share of the median around."""


class Descent:
    """Descends for one camera and one map, in arrays that are kept."""

    def __init__(self, renderer: Renderer, *, device: Any) -> None:
        """Prepare to compare pictures with what ``renderer`` renders."""
        self._renderer = renderer
        self._device = wp.get_device(device)
        row: Any = vec6
        self._pose_moments = wp.zeros(2, dtype=row, device=self._device)
        self._moments = wp.zeros((2, 2), dtype=float, device=self._device)
        self._steps = wp.zeros(2, dtype=wp.int32, device=self._device)
        parts = renderer.camera.height * pieces_per_row(self._device)
        self._sums = wp.empty((parts, 3), dtype=float, device=self._device)
        self._folded = wp.empty((FOLDED, 3), dtype=float, device=self._device)
        self._loss = wp.zeros(1, dtype=float, device=self._device)

    def run(
        self, frame: Frame, T_cw: Float64, exposure: tuple[float, float]
    ) -> tuple[Float64, tuple[float, float]]:
        """Return the pose [4, 4], world to camera, and the exposure; the search starts from those given."""
        r, device = self._renderer, self._device
        byte: Any = wp.uint8
        colour = wp.array(frame.rgb, dtype=byte, device=device)
        mask = wp.array(edge_mask(frame.rgb, _EDGE), dtype=byte, device=device)
        depth = None if frame.depth is None else wp.array(frame.depth, dtype=float, device=device)
        share = 0.0 if depth is None else _DEPTH_WEIGHT
        pose, shine = r.pose_array(se3.inverse(T_cw)), wp.array(exposure, dtype=float, device=device)
        for array in (self._pose_moments, self._moments, self._steps):
            array.zero_()
        now = T_cw
        for _ in range(_ITERATIONS):
            r.forward(pose)
            photometric_loss(
                r.image,
                r.transmittance,
                colour=colour,
                mask=mask,
                depth=depth,
                exposure=shine,
                weights=(1.0 - share, share),
                d_image=r.d_image,
                sums=self._sums,
                device=device,
            )
            r.adjoint_pose(pose)
            step_pose(
                r.d_pose,
                rates=_RATES,
                moments=self._pose_moments,
                steps=self._steps[:1],
                T_cw=pose,
                device=device,
            )
            step_exposure(
                self._sums,
                folded=self._folded,
                rate=_EXPOSURE_RATE,
                moments=self._moments,
                steps=self._steps[1:],
                exposure=shine,
                loss=self._loss,
                device=device,
            )
            before, now = now, to_host(pose)[0].astype(np.float64)
            if np.linalg.norm(se3.se3_log(now @ se3.inverse(before))) < _TOLERANCE:
                break
        a, b = to_host(shine).tolist()
        r.make_room()
        return se3.orthonormalised(now), (a, b)


def edge_mask(rgb: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    """Return which pixels' colours are compared, [h, w], 1 or 0.

    Args:
        rgb: [h, w, 3]; black is not compared.
        share: of the median change of a patch, that a pixel must exceed.
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    change = np.hypot(cv2.Scharr(grey, cv2.CV_32F, 1, 0), cv2.Scharr(grey, cv2.CV_32F, 0, 1))
    mask = np.zeros(grey.shape, np.uint8)
    for i in range(0, grey.shape[0], _PATCH):
        for j in range(0, grey.shape[1], _PATCH):
            patch = change[i : i + _PATCH, j : j + _PATCH]
            mask[i : i + _PATCH, j : j + _PATCH] = patch > share * np.median(patch)
    return mask * (rgb.max(axis=2) > _DARK)
