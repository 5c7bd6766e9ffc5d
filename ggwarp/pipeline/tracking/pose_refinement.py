# SPDX-License-Identifier: Apache-2.0
"""The pose at which the map looks like the picture: render, align the picture to that, render again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.uncertainty import position_std
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.tracking.pose_descent import Descent
from ggwarp.runtime.state import Stateful
from ggwarp.solvers.alignment import Aligner
from ggwarp.solvers.pose_equations import INDEPENDENCE, Prior, System
from ggwarp.types import Exposure, Float64, Frame

_TOLERANCE = 1e-4
"""No further render when the pose moved less, metres and radians."""

_MIN_SHARE = 0.2
"""A picture of which less can be compared with the map says nothing of the pose."""

_MAX_COST = 5.0
"""Nor does one that differs more: the robust cost of a pixel, from 0 to the robust scale squared."""

_MAX_POSITION_STD = 0.02
"""Nor does one that leaves the position more uncertain along some direction, metres."""


@dataclass(frozen=True)
class RefinementConfig:
    """How a pose is refined by colour (--tracker photometric)."""

    method: Literal["alignment", "descent"] = "alignment"
    """How a pose is found by rendering. alignment is Gauss-Newton on the picture against a render, which is
    then taken anew; descent is Adam through the renderer (MonoGS), with many times the renders."""


@dataclass(frozen=True)
class Refined:
    """A pose found by colour.

    Attributes:
        T_wc: [4, 4] camera-to-world.
        exposure: (a, b) of the picture: e^a render + b.
        share: of the pixels that could be compared.
        cost: mean robust cost of a pixel.
        objection: why it is not accepted, one clause; empty: nothing.
    """

    T_wc: Float64
    exposure: tuple[float, float]
    share: float
    cost: float
    objection: str

    def as_exposure(self) -> Exposure:
        """Return the exposure as the map takes it."""
        return Exposure.uniform(*self.exposure)


class Refiner(Stateful):
    """Refines poses of one camera against one map; keeps the last exposure to start from."""

    STATE = ("_exposure",)

    def __init__(self, config: RefinementConfig, renderer: Renderer, *, renders: int, device: Any) -> None:
        """Prepare to compare pictures with what ``renderer`` renders.

        Args:
            renders: an alignment renders so often at most: each from where the last one ended.
        """
        self._config = config
        self._renders = renders
        self._renderer = renderer
        self._aligner = Aligner(renderer.camera, device=device)
        self._descent = Descent(renderer, device=device)
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
        T_cw, exposure, system = search(frame, se3.inverse(T_wc), prior)
        share, objection = self._judge(system, prior)
        if not objection:
            self._exposure = exposure
        return Refined(se3.inverse(T_cw), exposure, share, system.mean_cost, objection)

    def _align(
        self, frame: Frame, T_cw: Float64, prior: Prior | None
    ) -> tuple[Float64, tuple[float, float], System]:
        exposure, renders = self._exposure, 0
        while True:
            self._render(T_cw)
            found = self._aligner.align(T_cw, exposure=exposure, prior=prior)
            moved = float(np.abs(se3.se3_log(found.T_cw @ se3.inverse(T_cw))).max())
            T_cw, exposure, renders = found.T_cw, found.exposure, renders + 1
            if renders >= self._renders or moved < _TOLERANCE:
                return T_cw, exposure, found.system

    def _descend(
        self, frame: Frame, T_cw: Float64, prior: Prior | None
    ) -> tuple[Float64, tuple[float, float], System]:
        T_cw, exposure = self._descent.run(frame, T_cw, self._exposure)
        self._render(T_cw)
        return T_cw, exposure, self._aligner.linearise(0, T_cw, exposure)

    def _render(self, T_cw: Float64) -> None:
        self._renderer.render(se3.inverse(T_cw))
        self._aligner.take_render(self._renderer.image, self._renderer.transmittance, T_cw)

    def _judge(self, system: System, prior: Prior | None) -> tuple[float, str]:
        """Return the share of the picture that was compared, and why the pose is not accepted."""
        camera = self._renderer.camera
        share = system.pixels / (camera.width * camera.height)
        information = INDEPENDENCE * system.H[:6, :6]
        std = position_std(information if prior is None else information + prior.information)
        if share < _MIN_SHARE:
            return share, f"only {share:.2f} of the picture can be compared with the map"
        if system.mean_cost > _MAX_COST:
            return (
                share,
                f"the picture differs from the map by {system.mean_cost:.1f} noise variances a pixel",
            )
        if std > _MAX_POSITION_STD:
            return share, f"colour leaves the position free to slide by {std:.3f} m"
        return share, ""
