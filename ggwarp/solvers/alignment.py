# SPDX-License-Identifier: Apache-2.0
"""Direct alignment of a camera's picture to others of known depth, coarse to fine, by Gauss-Newton.

The others are references: a render of the map, or pictures that were taken before with their depth.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.photometric import alignment, alignment_loop, image_pyramid
from ggwarp.runtime.graphs import GraphCache
from ggwarp.solvers.alignment_arrays import AlignmentLoopArrays, Comparison, Reference, unpacked, view_rows
from ggwarp.solvers.pose_equations import (
    EXPOSURE_PRECISION,
    INDEPENDENCE,
    Prior,
    System,
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
        coarse_pixels: int = _ENOUGH,
        recorded: bool | None = None,
        device: Any,
    ) -> None:
        """Prepare to align pictures of ``camera``'s size.

        Args:
            colour_noise: standard deviation of a colour, 0..1.
            agreement: see :class:`ggwarp.kernels.photometric.alignment.AlignmentProblem`.
            max_pixels: larger sizes than this are only made smaller; None: the picture's own is compared.
            coarse_pixels: so many of a coarser size are compared at most: fewer will do near the pose.
            recorded: record an alignment as a graph and replay it; the default does on CUDA where the driver
                has loops in graphs. On the CPU a recording runs on one thread.
        """
        self._device = wp.get_device(device)
        self.cameras = [camera]
        self._finest = 0
        while max_pixels is not None and self.cameras[-1].width * self.cameras[-1].height > max_pixels:
            self.cameras.append(halved(self.cameras[-1]))
            self._finest += 1
        for _ in range(_LEVELS - 1):
            self.cameras.append(halved(self.cameras[-1]))
        self._colour_noise, self._agreement, self._depth_noise = colour_noise, agreement, 0.0
        self._observed = self._empty_levels()
        self._rendered: Reference | None = None
        piece = alignment.piece_length(self._device)
        most = [_ENOUGH] * (self._finest + 1) + [coarse_pixels] * (_LEVELS - 1)
        sizes = [c.width * c.height for c in self.cameras]
        strides = [math.ceil((size / enough) ** 0.5) for size, enough in zip(sizes, most, strict=True)]
        self._sizes = [
            alignment.AlignmentSize(intrinsics_of(c), c.height, c.width, stride, piece)
            for c, stride in zip(self.cameras, strides, strict=True)
        ]
        if recorded is None:
            recorded = self._device.is_cuda and wp.is_conditional_graph_supported()
        self._recorded, self._graphs = recorded, GraphCache(self._device)
        self._arrays = AlignmentLoopArrays(1, self._sizes, self._device)

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
        return self._made(levels, se3.inverse(T_wc))

    def take_render(self, image: Any, transmittance: Any, T_cw: Float64) -> None:
        """Take a render from ``T_cw`` [4, 4] as the reference of those that follow.

        Args:
            image: [>= 4, Hp, Wp] colour and expected depth. transmittance: [Hp, Wp].
        """
        if self._rendered is None:
            self._rendered = self._made(self._empty_levels(), np.eye(4))
        self._rendered = replace(self._rendered, T_cw=np.array(T_cw, np.float64))
        levels = self._rendered.levels
        image_pyramid.pack_render(
            image,
            transmittance,
            min_opacity=_MIN_OPACITY,
            view=levels[0],
            device=self._device,
        )
        self._shrink(levels)

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
        references = references or [self._taken_render()]
        exposures = [exposure] * len(references)
        self._load(references, T_cw, exposures, prior, fit_exposure=fit_exposure)
        if self._recorded:
            count, room = len(references), self._arrays.references
            self._graphs.run(count, lambda: self._search(count), arrays=room)
        else:
            self._search(len(references))
        T, exposures, numbers, state = self._arrays.read(len(references))
        systems = [unpacked(row, self._sizes[self._finest].stride ** 2) for row in numbers]
        return Alignment(
            se3.orthonormalised(T),
            exposures,
            systems,
            pose_information(systems, prior),
            converged=bool(state[alignment_loop.CONVERGED]),
            iterations=int(state[alignment_loop.STEPS]),
        )

    def _search(self, references: int) -> None:
        for level in reversed(range(self._finest, self._finest + _LEVELS)):
            size = self._sizes[level]
            # A coarse pixel stands for the fine ones under it, one that is compared for those around it.
            share = 4.0 ** (level - self._finest)
            rules = alignment_loop.StepRules(
                share=INDEPENDENCE * share * size.stride**2,
                exposure_precision=EXPOSURE_PRECISION,
                iterations=_ITERATIONS,
                settled=_SETTLED,
                deviation_share=share,
                least_pixels=_LEAST_PIXELS / size.stride**2 if level > self._finest else 0.0,
            )
            alignment_loop.run_size(
                self._arrays.loop,
                rules,
                level=level,
                size=size,
                references=references,
                device=self._device,
            )

    def linearise(self, level: int, T_cw: Float64, exposure: tuple[float, float]) -> System:
        """Return the normal equations by the render, at ``T_cw`` [4, 4], of size ``level`` (0: the camera's).

        Of a large picture each pixel that is compared stands for those around it, too.
        """
        self._load([self._taken_render()], T_cw, [exposure])
        size = self._sizes[level]
        alignment.linearisation(
            self._arrays.loop, level=level, size=size, references=1, device=self._device
        )()
        return unpacked(self._arrays.read(1)[2][0], size.stride**2)

    def _load(
        self,
        references: Sequence[Reference],
        T_cw: Float64,
        exposures: list[tuple[float, float]],
        prior: Prior | None = None,
        *,
        fit_exposure: bool = True,
    ) -> None:
        if len(references) > self._arrays.references:
            self._arrays = AlignmentLoopArrays(len(references), self._sizes, self._device)
        comparison = Comparison(self._colour_noise, self._depth_noise, _ROBUST_SCALE, _EDGE, self._agreement)
        self._arrays.load(references, T_cw, exposures, comparison, prior, fit_exposure=fit_exposure)

    def _made(self, levels: list[Any], T_cw: Float64) -> Reference:
        return Reference(levels, T_cw, view_rows(levels, self._observed))

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
