# SPDX-License-Identifier: Apache-2.0
"""Fitting some Gaussians of a map to pictures, the others held."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.editing.progress import Progress, silent
from ggwarp.editing.windows import footprints, touching, window_round
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.losses.ssim import REACH
from ggwarp.kernels.optim.adam import AdamRates
from ggwarp.kernels.raster.project import Window
from ggwarp.map.gaussian_map import PARAMETERS, GaussianMap
from ggwarp.map.gaussian_optimiser import GaussianOptimiser, UploadedView
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.types import Float32, Float64

_RATES = AdamRates(means=1e-4, quats=2e-3, log_scales=5e-3, opacity=0.02, colours=5e-3)

_MARGIN = 2 * REACH  # pixels by which what is fitted may grow, and by which pictures are compared


@dataclass(frozen=True)
class RefitConfig:
    """How Gaussians are fitted to pictures."""

    iterations: int = 60
    """Iterations; each takes the next view."""
    views: int = 8
    """Views fitted to, at most."""
    depth_weight: float = 1.0
    """Of the depth error against the colour error."""
    rates: AdamRates = field(default_factory=lambda: _RATES)
    """Adam's learning rates."""


@dataclass(frozen=True)
class WantedView:
    """What a view should show.

    Attributes:
        T_wc: [4, 4] camera-to-world.
        rgb: [h, w, 3] uint8.
        depth: [h, w] metres; 0: the pixel does not count.
    """

    T_wc: Float64
    rgb: NDArray[np.uint8]
    depth: Float32


def fit(
    gaussians: Gaussians,
    free: NDArray[np.bool_],
    views: list[WantedView],
    camera: Camera,
    config: RefitConfig = RefitConfig(),
    *,
    device: Any = "cpu",
    progress: Progress = silent,
) -> Gaussians:
    """Return ``gaussians`` with those of ``free`` [n] fitted to ``views`` by colour and depth.

    The others keep every bit; ids and identities are left alone. Of each view only that part is rendered
    in which one of ``free`` shows.
    """
    if not views or not free.any():
        return gaussians
    movable = gaussians.take(free)
    windows = [window_round(footprints(movable, camera, v.T_wc), camera, margin=_MARGIN) for v in views]
    near = free.copy()
    for view, window in zip(views, windows, strict=True):
        if window is not None:
            near |= touching(footprints(gaussians, camera, view.T_wc), window)
    fitted = _fitted(gaussians.take(near), free[near], views, windows, camera, config, device, progress)
    merged = {n: getattr(gaussians, n).copy() for n in PARAMETERS if n != "identities"}
    for name, values in merged.items():
        values[near] = getattr(fitted, name)
    return replace(gaussians, **merged)


def _fitted(
    gaussians: Gaussians,
    free: NDArray[np.bool_],
    views: list[WantedView],
    windows: list[Window | None],
    camera: Camera,
    config: RefitConfig,
    device: Any,
    progress: Progress,
) -> Gaussians:
    """Return ``gaussians`` after the fit to the views' windows; None: a view shows nothing that is free."""
    model = GaussianMap(device=device, has_identity=False, capacity=len(gaussians))
    model.append(gaussians)
    renderer = Renderer(model, camera)
    optimiser = GaussianOptimiser(
        model, renderer, rates=config.rates, depth_weight=config.depth_weight, free=free
    )
    targets = [
        UploadedView(
            renderer.pose_array(view.T_wc),
            wp.array(view.rgb, dtype=wp.uint8, device=device),
            wp.array(view.depth, dtype=float, device=device),
        )
        for view in views
    ]
    for target, window in zip(targets, windows, strict=True):
        renderer.provide(target.T_cw, window=window)
    for iteration in range(config.iterations):
        progress("fitting", iteration / config.iterations)
        window = windows[iteration % len(targets)]
        if window is not None:
            optimiser.step(targets[iteration % len(targets)], window=window)
    return model.to_host()
