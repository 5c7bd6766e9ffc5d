# SPDX-License-Identifier: Apache-2.0
"""Keyframes' exposures: where they start, and how they are fitted with the map."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.kernels.photometric.affine_exposure import expose, expose_adjoint, step_exposure
from ggwarp.kernels.workspaces import allocate_exposure
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.mapping.keyframe import Keyframe, Keyframes
from ggwarp.types import Exposure, Float32, Frame, Rendered

_OPAQUE = 0.95
_DEPTH_TOLERANCE = 0.05
_DARK, _BRIGHT = 4.0 / 255.0, 250.0 / 255.0
_LEAST = 0.05
"""Share of the picture that the map must explain."""
_SMOOTH = 2.0
"""Pixels: the map is smoother than the picture, which alone would lower the gain."""
_RIDGE = 1e-3
_ROUNDS = 3
_PULL = 0.01
"""Weight of an exposure's squared size in the loss: keeps the map's brightness from drifting away."""


def estimate_exposure(frame: Frame, rendered: Rendered, default: Exposure) -> Exposure:
    """Return the exposure of ``frame``'s picture against the map's view from its pose.

    By channel, least squares over the pixels that the map explains, without those that stay far off.

    Args:
        rendered: the map's view, in the map's own exposure.
        default: for when the map explains too little of the picture.
    """
    picture = frame.rgb.astype(np.float32) / 255.0
    usable = rendered.opacity > _OPAQUE
    if frame.depth is not None:
        difference = np.abs(rendered.surface_depth - frame.depth)
        usable &= (frame.depth > 0.0) & (difference < _DEPTH_TOLERANCE * frame.depth)
    usable &= ((picture > _DARK) & (picture < _BRIGHT)).all(axis=2)
    if usable.mean() < _LEAST:
        return default
    y, x = (_smoothed(image, usable)[usable].astype(np.float64) for image in (picture, rendered.rgb))
    lines = np.array([_line(x[:, c], y[:, c]) for c in range(3)])
    gains, offsets = np.maximum(lines[:, 0], 0.05), lines[:, 1]
    return Exposure(tuple(np.log(gains).tolist()), tuple(offsets.tolist()))


def _smoothed(image: Float32, where: NDArray[np.bool_]) -> Float32:
    """Return the image [h, w, 3] blurred within ``where`` [h, w] alone."""
    weight = cv2.GaussianBlur(where.astype(np.float32), (0, 0), _SMOOTH)
    blurred = cv2.GaussianBlur(image * where[..., None], (0, 0), _SMOOTH)
    return np.asarray(blurred / np.maximum(weight, 1e-6)[..., None], np.float32)


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return slope and offset of y over x, held weakly at 1 and 0."""
    solution = np.array([1.0, 0.0])
    kept = np.ones(len(x), bool)
    for _ in range(_ROUNDS):
        design = np.stack([x[kept], np.ones(np.count_nonzero(kept))], axis=1)
        normal = design.T @ design / len(design) + _RIDGE * np.eye(2)
        right = design.T @ y[kept] / len(design) + _RIDGE * np.array([1.0, 0.0])
        solution = np.linalg.solve(normal, right)
        error = np.abs(y - solution[0] * x - solution[1])
        kept = error <= 3.0 * np.median(error) + 1e-6
    return solution


class ExposureModel:
    """The keyframes' exposures: where they begin, and how they are fitted with the map (MonoGS section 3.3).

    It shows a renderer's image as a keyframe's exposure makes it, and steps the exposure.

    Attributes:
        image: [4, Hp, Wp] the render as exposed, with its depth.
    """

    def __init__(self, renderer: Renderer, *, rate: float) -> None:
        """``rate``: see :func:`ggwarp.kernels.photometric.affine_exposure.step_exposure`."""
        self._renderer = renderer
        self._rate = rate
        camera = renderer.camera
        self._size = camera.height, camera.width
        self._device = renderer.image.device
        padded = renderer.image.shape[1], renderer.image.shape[2]
        self._workspace = allocate_exposure(*self._size, padded, device=self._device)
        self.image = self._workspace.exposed

    def begin(
        self, frame: Frame, rendered: Rendered | None, keyframes: Keyframes, tracked: Exposure | None
    ) -> Exposure:
        """Return where the exposure of a new keyframe starts; the first one has the map's own.

        Args:
            rendered: the map's view from the frame's pose; None while the map is empty.
            keyframes: those before it.
            tracked: as tracking found it, if it did.
        """
        if rendered is None or not keyframes:
            return Exposure()
        return tracked or estimate_exposure(frame, rendered, keyframes.exposure(-1))

    def show(self, keyframe: Keyframe) -> None:
        """Write :attr:`image`."""
        height, width = self._size
        expose(
            self._renderer.image,
            keyframe.exposure,
            height=height,
            width=width,
            exposed=self.image,
            device=self._device,
        )

    def step(self, keyframe: Keyframe) -> None:
        """Take the renderer's ``d_image``, by :attr:`image`, back to the render, and step the exposure."""
        height, width = self._size
        expose_adjoint(
            self._renderer.image,
            keyframe.exposure,
            height=height,
            width=width,
            d_image=self._renderer.d_image,
            workspace=self._workspace,
            device=self._device,
        )
        step_exposure(
            keyframe.exposure,
            rate=self._rate,
            pull=_PULL,
            moments=keyframe.exposure_moments,
            steps=keyframe.exposure_steps,
            workspace=self._workspace,
            device=self._device,
        )
