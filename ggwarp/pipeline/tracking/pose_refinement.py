# SPDX-License-Identifier: Apache-2.0
"""The pose at which the map looks like the picture: render, align the picture to that, render again."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ggwarp.geometry import se3
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.tracking.motion_model import position_std
from ggwarp.pipeline.tracking.pose_descent import Descent, DescentConfig
from ggwarp.solvers.alignment import Aligner, AlignmentConfig, Prior, System
from ggwarp.types import Exposure, Float64, Frame


@dataclass(frozen=True)
class RefinementConfig:
    """How a pose is refined by colour, and when the result is accepted."""

    method: Literal["alignment", "descent"] = "alignment"
    """alignment: Gauss-Newton on the picture against a render, which is then taken anew; descent: Adam
    through the renderer, as published (MonoGS), with many times the renders."""
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    descent: DescentConfig = field(default_factory=DescentConfig)
    renders: int = 2
    """Renders at most: each from where the last alignment ended."""
    tolerance: float = 1e-4
    """No further render when the pose moved less, metres and radians."""
    min_share: float = 0.2
    """A picture of which less can be compared with the map says nothing of the pose."""
    max_cost: float = 5.0
    """Nor does one that differs more: the robust cost of a pixel, from 0 to robust_scale^2."""
    max_position_std: float = 0.02
    """Nor does one that leaves the position more uncertain along some direction, metres."""


@dataclass(frozen=True)
class Refined:
    """A pose found by colour.

    Attributes:
        T_wc: [4, 4] camera-to-world.
        exposure: (a, b) of the picture: e^a render + b.
        share: of the pixels that could be compared.
        cost: mean robust cost of a pixel.
        renders, iterations: spent.
        objection: why it is not accepted, one clause; empty: nothing.
    """

    T_wc: Float64
    exposure: tuple[float, float]
    share: float
    cost: float
    renders: int
    iterations: int
    objection: str

    def as_exposure(self) -> Exposure:
        """Return the exposure as the map takes it."""
        return Exposure.uniform(*self.exposure)


@dataclass(frozen=True)
class _Search:
    T_cw: Float64
    exposure: tuple[float, float]
    system: System
    renders: int
    iterations: int


class Refiner:
    """Refines poses of one camera against one map; keeps the last exposure to start from."""

    def __init__(self, config: RefinementConfig, renderer: Renderer, *, device: Any) -> None:
        """Prepare to compare pictures with what ``renderer`` renders."""
        self._config = config
        self._renderer = renderer
        self._aligner = Aligner(config.alignment, renderer.camera, device=device)
        self._descent = Descent(config.descent, renderer, device=device)
        self._exposure = (0.0, 0.0)

    def refine(
        self, frame: Frame, T_wc: Float64, *, prior: Prior | None = None, with_depth: bool = False
    ) -> Refined:
        """Search the pose of ``frame``'s colour near ``T_wc`` [4, 4].

        Args:
            with_depth: compare depth, too, if the frame has it.
            prior: what else is known of the pose; a descent makes no use of it.
        """
        self._aligner.take_picture(frame.rgb, frame.depth if with_depth else None)
        search = self._align if self._config.method == "alignment" else self._descend
        return self._judged(search(frame, se3.inverse(T_wc), prior), prior)

    def _align(self, frame: Frame, T_cw: Float64, prior: Prior | None) -> _Search:
        exposure, renders, iterations = self._exposure, 0, 0
        while True:
            self._render(T_cw)
            found = self._aligner.align(T_cw, exposure=exposure, prior=prior)
            moved = float(np.abs(se3.se3_log(found.T_cw @ se3.inverse(T_cw))).max())
            T_cw, exposure = found.T_cw, found.exposure
            renders, iterations = renders + 1, iterations + found.iterations
            if renders >= self._config.renders or moved < self._config.tolerance:
                return _Search(T_cw, exposure, found.system, renders, iterations)

    def _descend(self, frame: Frame, T_cw: Float64, prior: Prior | None) -> _Search:
        T_cw, exposure, renders = self._descent.run(frame, T_cw, self._exposure)
        self._render(T_cw)
        return _Search(
            T_cw, exposure, self._aligner.linearise(0, T_cw, exposure), renders + 1, iterations=renders
        )

    def _render(self, T_cw: Float64) -> None:
        self._renderer.render(se3.inverse(T_cw))
        self._aligner.take_render(self._renderer.image, self._renderer.transmittance, T_cw)

    def _judged(self, found: _Search, prior: Prior | None) -> Refined:
        c, system, camera = self._config, found.system, self._renderer.camera
        share = system.pixels / (camera.width * camera.height)
        information = c.alignment.independence * system.H[:6, :6]
        std = position_std(information if prior is None else information + prior.information)
        objection = ""
        if share < c.min_share:
            objection = f"only {share:.2f} of the picture can be compared with the map"
        elif system.mean_cost > c.max_cost:
            objection = f"the picture differs from the map by {system.mean_cost:.1f} noise variances a pixel"
        elif std > c.max_position_std:
            objection = f"colour leaves the position free to slide by {std:.3f} m"
        if not objection:
            self._exposure = found.exposure
        return Refined(
            se3.inverse(found.T_cw),
            found.exposure,
            share,
            system.mean_cost,
            found.renders,
            found.iterations,
            objection,
        )
