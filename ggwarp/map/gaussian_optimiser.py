# SPDX-License-Identifier: Apache-2.0
"""One step of fitting Gaussians to a view: render, compare, take the gradient back, Adam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.kernels.losses.rgbd import DEPTH, DSSIM, L1, LOSS_COUNT, rgbd_loss
from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.adam import AdamRates, adam_gaussians, hold_rows
from ggwarp.kernels.raster.project import Window
from ggwarp.kernels.workspaces import allocate_loss
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.runtime.state import Stateful

_COLOUR_WEIGHT = 1.0
"""l_rgb of the loss (GG-SLAM eq. 5)."""
_DSSIM = 0.2
"""Share of 1 - SSIM in the colour loss (eq. 6)."""
_DEPTH_UNIT = 10.0
"""Of eq. 7, metres."""


class TargetView(Protocol):
    """What a view should show, on the device."""

    @property
    def T_cw(self) -> wp.array:
        """[1] mat44, world to camera."""
        ...

    @property
    def colour(self) -> wp.array:
        """[h, w, 3] uint8."""
        ...

    @property
    def depth(self) -> wp.array:
        """[h, w] float, metres, 0 = none."""
        ...

    @property
    def depth_weights(self) -> wp.array | None:
        """[h, w] uint8 how much each reading counts, 64 for one; None: all alike."""
        ...

    @property
    def has_depth(self) -> bool:
        """Whether colour counts only where there is depth."""
        ...


@dataclass(frozen=True)
class UploadedView:
    """A :class:`TargetView` that is nothing else."""

    T_cw: wp.array
    colour: wp.array
    depth: wp.array
    has_depth: bool = True
    depth_weights: wp.array | None = None


class GaussianOptimiser(Stateful):
    """Fits Gaussians to one view at a time.

    :meth:`step` does all of it. Who has more to fit calls :meth:`compare` and :meth:`update` between passes
    of the renderer of their own.

    Attributes:
        losses: [LOSS_COUNT] of the last comparison, unweighted.
        loss_weights: entry of ``losses`` -> its weight in the total (GG-SLAM eq. 5).
    """

    STATE = ("losses",)  # those that are not due in an iteration stay

    def __init__(
        self,
        gaussians: GaussianMap,
        renderer: Renderer,
        *,
        rates: AdamRates,
        depth_weight: float,
        rate_decay: float = 0.0,
        free: NDArray[np.bool_] | None = None,
    ) -> None:
        """Prepare to fit ``gaussians``, which ``renderer`` shows.

        Args:
            depth_weight: l_d of the loss.
            rate_decay: see :func:`ggwarp.kernels.optim.adam.adam_gaussians`.
            free: [count] which Gaussians are fitted, the others keeping every bit; None: all. With it the
                map must not grow.
        """
        self._map, self._renderer = gaussians, renderer
        self._device = gaussians.device
        self._depth_weight, self._rate_decay = depth_weight, rate_decay
        camera = renderer.camera
        self._workspace = allocate_loss(camera.height, camera.width, device=self._device)
        self._rates = wp.array(rates.lanes(), dtype=vec16, device=self._device)
        self.losses = wp.zeros(LOSS_COUNT, dtype=float, device=self._device)
        self.loss_weights = {
            L1: _COLOUR_WEIGHT * (1.0 - _DSSIM),
            DSSIM: _COLOUR_WEIGHT * _DSSIM,
            DEPTH: depth_weight,
        }
        self._free = self._ranks = None
        if free is not None:
            self._free = wp.array(free.astype(np.int32), dtype=int, device=self._device)
            self._ranks = wp.empty_like(self._free)

    def step(self, view: TargetView, *, window: Window | None = None) -> None:
        """Fit the Gaussians to ``view`` once, or those in a ``window`` of it; wait for nothing on CUDA."""
        self._renderer.forward(view.T_cw, window=window)
        self.compare(view, self._renderer.image)
        self._renderer.adjoint(view.T_cw)
        self.update()

    def compare(self, view: TargetView, image: Any) -> None:
        """Write :attr:`losses`, and their gradient by ``image`` to the renderer's ``d_image`` (eq. 5).

        Args:
            image: [C, Hp, Wp] the render of ``view``, perhaps as exposed.
        """
        rgbd_loss(
            image,
            view.colour,
            view.depth,
            d_image=self._renderer.d_image,
            losses=self.losses,
            workspace=self._workspace,
            colour_weight=_COLOUR_WEIGHT,
            dssim=_DSSIM,
            depth_weight=self._depth_weight,
            d_max=_DEPTH_UNIT,
            mask_colour=view.has_depth,
            depth_weights=view.depth_weights,
            device=self._device,
        )

    def update(self) -> None:
        """Take a step of Adam with the renderer's gradients; after its adjoint."""
        ranks = self._renderer.ranks
        if self._free is not None:
            hold_rows(ranks, free=self._free, out=self._ranks, device=self._device)
            ranks = self._ranks
        adam_gaussians(
            self._map.parameters,
            self._renderer.gradients,
            self._map.adam_state,
            rates=self._rates,
            ranks=ranks,
            device=self._device,
            decay=self._rate_decay,
        )
