# SPDX-License-Identifier: Apache-2.0
"""Fitting some Gaussians of a map to pictures, the others held."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.losses.rgbd import LOSS_COUNT, rgbd_loss
from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.adam import AdamRates, adam_gaussians
from ggwarp.kernels.workspaces import allocate_loss
from ggwarp.map.gaussian_map import PARAMETERS, GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32, Float64

_RATES = AdamRates(means=1e-4, quats=2e-3, log_scales=5e-3, opacity=0.02, colours=5e-3)


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
class Target:
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
    targets: list[Target],
    camera: Camera,
    config: RefitConfig = RefitConfig(),
    *,
    device: Any = "cpu",
) -> Gaussians:
    """Return ``gaussians`` with those of ``free`` [n] fitted to ``targets`` by colour and depth.

    The others keep every bit; ids and identities are left alone.
    """
    if not targets or not free.any():
        return gaussians
    model = GaussianMap(device=device, has_identity=False, capacity=len(gaussians))
    model.append(gaussians)
    renderer = Renderer(model, camera)
    workspace = allocate_loss(camera.height, camera.width, device=device)
    losses = wp.zeros(LOSS_COUNT, dtype=float, device=device)
    rates = wp.array(config.rates.lanes(), dtype=vec16, device=device)
    uploaded = [
        (
            renderer.pose_array(t.T_wc),
            wp.array(t.rgb, dtype=wp.uint8, device=device),
            wp.array(t.depth, dtype=float, device=device),
        )
        for t in targets
    ]
    for pose, _, _ in uploaded:
        renderer.provide(pose)
    for iteration in range(config.iterations):
        pose, rgb, depth = uploaded[iteration % len(uploaded)]
        renderer.forward(pose)
        rgbd_loss(
            renderer.image,
            rgb,
            depth,
            d_image=renderer.d_image,
            losses=losses,
            workspace=workspace,
            depth_weight=config.depth_weight,
            device=device,
        )
        renderer.adjoint(pose)
        visible = to_host(renderer.tiles.ranks)[: len(gaussians)]
        held = wp.array(np.where(free, visible, -1).astype(np.int32), dtype=int, device=device)
        adam_gaussians(
            model.parameters,
            renderer.gradients,
            model.adam_state,
            rates=rates,
            ranks=held,
            device=device,
        )
    fitted = model.to_host()
    return replace(gaussians, **{n: getattr(fitted, n) for n in PARAMETERS if n != "identities"})
