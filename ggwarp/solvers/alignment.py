# SPDX-License-Identifier: Apache-2.0
"""Direct alignment of a camera's picture to others of known depth, coarse to fine, by Gauss-Newton.

The others are references: a render of the map, or pictures that were taken before with their depth.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.photometric import alignment, image_pyramid
from ggwarp.runtime.streams import to_host
from ggwarp.solvers.pose_equations import (
    POSE,
    Prior,
    System,
    gauss_newton_step,
    joint_equations,
    pose_information,
)
from ggwarp.types import Float32, Float64

_LEVELS = 3
"""Sizes of the pictures, each half of the one before."""

_ITERATIONS = 6
"""Steps at each size at most."""

_SETTLED = 0.1
"""A size is done when a step is smaller, in standard deviations of what its own pixels say."""

_LEAST_PIXELS = 10 * alignment.PARAMETERS
"""A smaller picture that has fewer to compare decides nothing: ten observations an unknown."""

_ENOUGH = 20_000
"""Pixels of a size that are compared, at most: the errors of neighbours are alike, see ``INDEPENDENCE``."""

_COLOUR_NOISE = 0.05
"""Standard deviation of a colour, 0..1."""

_DEPTH_NOISE = 0.08
"""Standard deviation of a rendered depth, metres: much, as its errors go together."""

_ROBUST_SCALE = 3.0
"""Standard deviations at which Geman-McClure's kernel halves a residual's share of the cost."""

_EDGE = 0.05
"""Nothing is compared where the rendered depth jumps by more than this share within a pixel."""

_MIN_OPACITY = 0.95
"""Nothing is compared where the render is less opaque."""


@dataclass(frozen=True)
class Reference:
    """What a picture is aligned to.

    Attributes:
        levels: its views, finest first; see :mod:`ggwarp.kernels.photometric.image_pyramid`.
        T_cw: [4, 4] world to camera.
    """

    levels: list[Any]
    T_cw: Float64


@dataclass(frozen=True)
class Alignment:
    """Where an alignment ended.

    Attributes:
        T_cw: [4, 4] world to camera.
        exposures: (a, b) against each reference.
        systems: of each reference at the finest size, one step before the end.
        information: [6, 6] of tau, inverse covariance if the noise is what it is taken for: of all references
            and the prior, whatever the exposures are.
        converged: whether the last step was a small part of its standard deviation.
        iterations: steps in all.
    """

    T_cw: Float64
    exposures: list[tuple[float, float]]
    systems: list[System]
    information: Float64
    converged: bool
    iterations: int

    @property
    def exposure(self) -> tuple[float, float]:
        """Against the first reference."""
        return self.exposures[0]

    @property
    def system(self) -> System:
        """Of the first reference."""
        return self.systems[0]


def halved(camera: Camera) -> Camera:
    """Return the camera whose pixels are 2 x 2 of ``camera``'s; an odd last row or column is left out."""
    return Camera(
        camera.width // 2,
        camera.height // 2,
        camera.fx / 2.0,
        camera.fy / 2.0,
        (camera.cx - 0.5) / 2.0,
        (camera.cy - 0.5) / 2.0,
    )


class Aligner:
    """Aligns pictures of one camera to references, in arrays that are kept.

    Attributes:
        cameras: of each size, finest first.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        colour_noise: float = _COLOUR_NOISE,
        agreement: float = 0.0,
        max_pixels: int | None = None,
        device: Any,
    ) -> None:
        """Prepare to align pictures of ``camera``'s size.

        Args:
            colour_noise: standard deviation of a colour, 0..1.
            agreement: see :func:`ggwarp.kernels.photometric.alignment.linearise`.
            max_pixels: larger sizes than this are only made smaller; None: the picture's own is compared.
        """
        self._device = wp.get_device(device)
        self.cameras = [camera]
        self._finest = 0
        while max_pixels is not None and self.cameras[-1].width * self.cameras[-1].height > max_pixels:
            self.cameras.append(halved(self.cameras[-1]))
            self._finest += 1
        for _ in range(_LEVELS - 1):
            self.cameras.append(halved(self.cameras[-1]))
        self._noise, self._agreement, self._depth_noise = colour_noise, agreement, 0.0
        self._observed = self._empty_levels()
        self._rendered: Reference | None = None
        self._strides = [math.ceil((c.width * c.height / _ENOUGH) ** 0.5) for c in self.cameras]
        items = max(
            alignment.item_count(c.height, c.width, stride)
            for c, stride in zip(self.cameras, self._strides, strict=True)
        )
        self._sums = wp.empty((items, alignment.SUMS), dtype=float, device=self._device)
        total: Any = wp.float64
        self._folded = wp.empty((alignment.FOLDED, alignment.SUMS), dtype=total, device=self._device)
        self._system = wp.zeros(alignment.SUMS, dtype=total, device=self._device)

    @property
    def compared_camera(self) -> Camera:
        """The camera of the finest size that is compared."""
        return self.cameras[self._finest]

    def _empty_levels(self, shared: Sequence[Any] = ()) -> list[Any]:
        """Return a view's levels; ``shared`` are the finest, which are only made smaller."""
        row: Any = wp.vec4
        own = self.cameras[len(shared) :]
        return [*shared, *(wp.zeros((c.height, c.width), dtype=row, device=self._device) for c in own)]

    def take_picture(
        self, rgb: NDArray[np.uint8], depth: Float32 | None = None, *, compare_depth: bool = True
    ) -> None:
        """Take what the camera sees: ``rgb`` [h, w, 3] and ``depth`` [h, w], metres, 0 = none.

        Args:
            compare_depth: it is a measurement, too; else it only says what is hidden.
        """
        self._depth_noise = _DEPTH_NOISE if compare_depth and depth is not None else 0.0
        self._pack(rgb, depth, self._observed)

    def reference(self, rgb: NDArray[np.uint8], depth: Float32, T_wc: Float64) -> Reference:
        """Return a picture of this camera from ``T_wc`` [4, 4], with its depth, to align others to."""
        levels = self._empty_levels(self._observed[: self._finest])
        self._pack(rgb, depth, levels)
        return Reference(levels, se3.inverse(T_wc))

    def take_render(self, image: Any, transmittance: Any, T_cw: Float64) -> None:
        """Take a render from ``T_cw`` [4, 4] as the reference of those that follow.

        Args:
            image: [>= 4, Hp, Wp] colour and expected depth. transmittance: [Hp, Wp].
        """
        levels = self._rendered.levels if self._rendered else self._empty_levels()
        image_pyramid.pack_render(
            image,
            transmittance,
            min_opacity=_MIN_OPACITY,
            view=levels[0],
            device=self._device,
        )
        self._shrink(levels)
        self._rendered = Reference(levels, np.array(T_cw, np.float64))

    def align(
        self,
        T_cw: Float64,
        *,
        references: Sequence[Reference] = (),
        exposure: tuple[float, float] = (0.0, 0.0),
        fit_exposure: bool = True,
        prior: Prior | None = None,
    ) -> Alignment:
        """Search the pose from which the picture was taken, near those of the references.

        Args:
            T_cw: [4, 4] world to camera, where to start.
            references: what to align to; none: the render.
            exposure: (a, b) to start from; the picture is e^a reference + b.
            fit_exposure: search (a, b), too, for each reference.
            prior: weighed against the pixels' information.

        Raises:
            ValueError: there is no reference, nor a render.
        """
        if not references:
            references = [self._taken_render()]
        T, exposures = np.array(T_cw, np.float64), [exposure] * len(references)
        systems: list[System] = []
        H, converged, iterations = np.zeros((8, 8)), False, 0
        for level in reversed(range(self._finest, self._finest + _LEVELS)):
            for _ in range(_ITERATIONS):
                pairs = zip(references, exposures, strict=True)
                systems = [self.linearise(level, T, e, reference) for reference, e in pairs]
                if level > self._finest and sum(s.pixels for s in systems) < _LEAST_PIXELS:
                    break
                # A coarse pixel stands for the fine ones under it.
                share = 4.0 ** (level - self._finest)
                H, gradient = joint_equations(systems, share, T, exposures, prior)
                step = gauss_newton_step(H, gradient, len(H) if fit_exposure else POSE)
                T = se3.se3_exp(step[:POSE]) @ T
                changes = step[POSE:].reshape(-1, 2).tolist()
                exposures = [(a + da, b + db) for (a, b), (da, db) in zip(exposures, changes, strict=True)]
                iterations += 1
                converged = bool(step @ H @ step < share * _SETTLED**2)
                if converged:
                    break
        T_cw = se3.orthonormalised(T)
        return Alignment(T_cw, exposures, systems, pose_information(H), converged, iterations)

    def linearise(
        self,
        level: int,
        T_cw: Float64,
        exposure: tuple[float, float],
        reference: Reference | None = None,
    ) -> System:
        """Return the normal equations at ``T_cw`` [4, 4] for pictures of size ``level`` (0: the camera's).

        Of a large picture each pixel that is compared stands for those around it, too.

        Args:
            reference: None: the render.
        """
        reference = reference or self._taken_render()
        alignment.linearise(
            reference.levels[level],
            self._observed[level],
            intrinsics_of(self.cameras[level]),
            motion=_matrix(T_cw @ se3.inverse(reference.T_cw)),
            exposure=exposure,
            noise=(self._noise, _ROBUST_SCALE, _EDGE, self._depth_noise),
            agreement=self._agreement,
            stride=self._strides[level],
            sums=self._sums,
            folded=self._folded,
            system=self._system,
            device=self._device,
        )
        numbers = to_host(self._system) * float(self._strides[level] ** 2)
        H = np.zeros((alignment.PARAMETERS, alignment.PARAMETERS))
        H[np.triu_indices(alignment.PARAMETERS)] = numbers[:36]
        return System(
            H=H + np.triu(H, 1).T,
            gradient=np.array(numbers[36:44], np.float64),
            cost=float(numbers[44]),
            pixels=int(numbers[45]),
        )

    def _taken_render(self) -> Reference:
        if self._rendered is None:
            raise ValueError("nothing to align to: neither references nor a render")
        return self._rendered

    def _pack(self, rgb: NDArray[np.uint8], depth: Float32 | None, levels: list[Any]) -> None:
        byte: Any = wp.uint8
        colour = wp.array(rgb, dtype=byte, device=self._device)
        readings = None if depth is None else wp.array(depth, dtype=float, device=self._device)
        image_pyramid.pack_picture(colour, readings, view=levels[0], device=self._device)
        self._shrink(levels)

    def _shrink(self, levels: list[Any]) -> None:
        for fine, coarse in itertools.pairwise(levels):
            image_pyramid.halve(fine, edge=_EDGE, coarse=coarse, device=self._device)


def _matrix(T: Float64) -> wp.mat44:
    return wp.mat44(*np.asarray(T, np.float32).ravel().tolist())
