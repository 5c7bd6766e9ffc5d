# SPDX-License-Identifier: Apache-2.0
"""Direct alignment of a camera's picture to a rendered one, coarse to fine, by Gauss-Newton."""

from __future__ import annotations

import itertools
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
from ggwarp.types import Float32, Float64

INDEPENDENCE = 0.03
"""Share of the pixels that count: the errors of neighbours are alike."""

_LEVELS = 3
"""Sizes of the pictures, each half of the one before."""

_ITERATIONS = 6
"""Steps at each size at most."""

_TOLERANCE = 1e-5
"""A size is done when a step is smaller, metres and radians."""

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

_EXPOSURE_DEVIATION = 0.3
"""Expected deviation of the exposure's parameters from 0, one standard deviation."""


@dataclass(frozen=True)
class Prior:
    """What is known of a pose beforehand.

    Attributes:
        T_cw: [4, 4] world to camera.
        information: [6, 6] inverse covariance of tau in T_cw <- Exp(tau) T_cw.
    """

    T_cw: Float64
    information: Float64


@dataclass(frozen=True)
class System:
    """Normal equations for (tau, a, b), without a prior.

    Attributes:
        H: [8, 8]. gradient: [8].
        cost: of colour, robust, a sum.
        pixels: whose colour is compared.
    """

    H: Float64
    gradient: Float64
    cost: float
    pixels: int

    @property
    def mean_cost(self) -> float:
        """Robust cost of a pixel, 0 to the robust scale squared; inf where none was compared."""
        return self.cost / self.pixels if self.pixels else float("inf")


@dataclass(frozen=True)
class Alignment:
    """Where an alignment ended.

    Attributes:
        T_cw: [4, 4] world to camera. exposure: (a, b).
        system: at the finest size, one step before the end.
        converged: whether the last step was below the tolerance.
        iterations: steps in all.
    """

    T_cw: Float64
    exposure: tuple[float, float]
    system: System
    converged: bool
    iterations: int


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
    """Aligns pictures of one camera to renders for it, in arrays that are kept.

    Attributes:
        cameras: of each size, finest first.
    """

    def __init__(self, camera: Camera, *, device: Any) -> None:
        self._device = wp.get_device(device)
        self.cameras = [camera]
        for _ in range(_LEVELS - 1):
            self.cameras.append(halved(self.cameras[-1]))
        sizes = [(c.height, c.width) for c in self.cameras]
        row: Any = wp.vec4
        self._rendered, self._observed = (
            [wp.zeros(size, dtype=row, device=self._device) for size in sizes] for _ in range(2)
        )
        self._T_rw, self._depth_noise = np.eye(4), 0.0
        items = alignment.item_count(*sizes[0])
        self._sums = wp.empty((items, alignment.SUMS), dtype=float, device=self._device)
        total: Any = wp.float64
        self._system = wp.zeros(alignment.SUMS, dtype=total, device=self._device)

    def take_picture(self, rgb: NDArray[np.uint8], depth: Float32 | None = None) -> None:
        """Take what the camera sees: ``rgb`` [h, w, 3] and ``depth`` [h, w], metres, 0 = none."""
        byte: Any = wp.uint8
        colour = wp.array(rgb, dtype=byte, device=self._device)
        readings = None if depth is None else wp.array(depth, dtype=float, device=self._device)
        self._depth_noise = 0.0 if depth is None else _DEPTH_NOISE
        image_pyramid.pack_picture(colour, readings, view=self._observed[0], device=self._device)
        self._shrink(self._observed)

    def take_render(self, image: Any, transmittance: Any, T_cw: Float64) -> None:
        """Take a render from ``T_cw`` [4, 4].

        Args:
            image: [>= 4, Hp, Wp] colour and expected depth. transmittance: [Hp, Wp].
        """
        image_pyramid.pack_render(
            image,
            transmittance,
            min_opacity=_MIN_OPACITY,
            view=self._rendered[0],
            device=self._device,
        )
        self._shrink(self._rendered)
        self._T_rw = np.array(T_cw, np.float64)

    def align(
        self,
        T_cw: Float64,
        *,
        exposure: tuple[float, float] = (0.0, 0.0),
        fit_exposure: bool = True,
        prior: Prior | None = None,
    ) -> Alignment:
        """Search the pose from which the picture was taken, near that of the render.

        Args:
            T_cw: [4, 4] world to camera, where to start.
            exposure: (a, b) to start from; the picture is e^a render + b.
            fit_exposure: search (a, b), too.
            prior: weighed against the pixels' information.
        """
        T, (a, b) = np.array(T_cw, np.float64), exposure
        system, converged, iterations = None, False, 0
        for level in reversed(range(_LEVELS)):
            for _ in range(_ITERATIONS):
                system = self.linearise(level, T, (a, b))
                step = self._step(system, level, T, (a, b), fit_exposure, prior)
                T = se3.se3_exp(step[:6]) @ T
                a, b = a + float(step[6]), b + float(step[7])
                iterations += 1
                converged = bool(max(np.linalg.norm(step[:3]), np.linalg.norm(step[3:6])) < _TOLERANCE)
                if converged:
                    break
        assert system is not None
        return Alignment(se3.orthonormalised(T), (a, b), system, converged, iterations)

    def linearise(
        self,
        level: int,
        T_cw: Float64,
        exposure: tuple[float, float],
    ) -> System:
        """Return the normal equations at ``T_cw`` [4, 4] for pictures of size ``level`` (0: the finest)."""
        alignment.linearise(
            self._rendered[level],
            self._observed[level],
            intrinsics_of(self.cameras[level]),
            motion=_matrix(T_cw @ se3.inverse(self._T_rw)),
            exposure=exposure,
            noise=(_COLOUR_NOISE, _ROBUST_SCALE, _EDGE, self._depth_noise),
            sums=self._sums,
            system=self._system,
            device=self._device,
        )
        numbers = to_host(self._system)
        H = np.zeros((alignment.PARAMETERS, alignment.PARAMETERS))
        H[np.triu_indices(alignment.PARAMETERS)] = numbers[:36]
        return System(
            H=H + np.triu(H, 1).T,
            gradient=np.array(numbers[36:44], np.float64),
            cost=float(numbers[44]),
            pixels=int(numbers[45]),
        )

    def _step(
        self,
        system: System,
        level: int,
        T_cw: Float64,
        exposure: tuple[float, float],
        fit_exposure: bool,
        prior: Prior | None,
    ) -> Float64:
        """Return the Gauss-Newton step (tau, a, b) [8]; zeros where nothing fixes the pose."""
        # A coarse pixel stands for the fine ones under it.
        share = INDEPENDENCE * 4.0**level
        H, gradient = share * system.H, share * system.gradient
        if prior is not None:
            H[:6, :6] += prior.information
            gradient[:6] += prior.information @ se3.se3_log(T_cw @ se3.inverse(prior.T_cw))
        precision = 1.0 / _EXPOSURE_DEVIATION**2
        H[[6, 7], [6, 7]] += precision
        gradient[6:] += precision * np.array(exposure)
        used = 8 if fit_exposure else 6
        step = np.zeros(8)
        # A hundred-thousandth of the diagonal steadies directions that nothing fixes.
        H[range(8), range(8)] *= 1.0 + 1e-5
        try:
            step[:used] = np.linalg.solve(H[:used, :used], -gradient[:used])
        except np.linalg.LinAlgError:
            return np.zeros(8)
        return step if np.isfinite(step).all() else np.zeros(8)

    def _shrink(self, levels: list[Any]) -> None:
        for fine, coarse in itertools.pairwise(levels):
            image_pyramid.halve(fine, edge=_EDGE, coarse=coarse, device=self._device)


def _matrix(T: Float64) -> wp.mat44:
    return wp.mat44(*np.asarray(T, np.float32).ravel().tolist())
