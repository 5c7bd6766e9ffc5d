# SPDX-License-Identifier: Apache-2.0
"""One step of fitting Gaussians: all of them, or some while the others keep every bit."""

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.optim.adam import AdamRates
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussian_optimiser import GaussianOptimiser, UploadedView
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer

CAMERA = Camera(48, 32, 40.0, 40.0, 23.5, 15.5)
RATES = AdamRates(means=1e-3, quats=1e-2, log_scales=1e-2, opacity=0.05, colours=0.05)


def wall(rng: np.random.Generator, count: int = 80) -> Gaussians:
    means = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.full(count, 2.0)]).astype(np.float32)
    return Gaussians(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), np.log(0.1), np.float32),
        np.full(count, 1.0, np.float32),
        rng.normal(scale=0.3, size=(count, 3)).astype(np.float32),
    )


def fitted(
    device: str, gaussians: Gaussians, free: np.ndarray | None, steps: int = 30
) -> tuple[Gaussians, list[float]]:
    model = GaussianMap(device=device, has_identity=False, capacity=100)
    model.append(gaussians)
    renderer = Renderer(model, CAMERA)
    optimiser = GaussianOptimiser(model, renderer, rates=RATES, depth_weight=4.0, free=free)
    view = UploadedView(
        renderer.pose_array(np.eye(4)),
        wp.array(np.full((32, 48, 3), 200, np.uint8), dtype=wp.uint8, device=device),
        wp.array(np.full((32, 48), 2.2, np.float32), dtype=float, device=device),
    )
    losses = []
    for _ in range(steps):
        optimiser.step(view)
        values = optimiser.losses.numpy()
        losses.append(sum(weight * values[entry] for entry, weight in optimiser.loss_weights.items()))
    return model.to_host(), losses


def test_the_loss_falls(device: str, rng: np.random.Generator) -> None:
    _, losses = fitted(device, wall(rng), None)
    assert losses[-1] < 0.6 * losses[0]


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_held_gaussians_keep_every_bit(share: float, device: str, rng: np.random.Generator) -> None:
    gaussians = wall(rng)
    free = np.arange(len(gaussians)) < share * len(gaussians)
    after, losses = fitted(device, gaussians, free)
    for name in ("means", "quats", "log_scales", "opacity_logits", "colours"):
        np.testing.assert_array_equal(getattr(after, name)[~free], getattr(gaussians, name)[~free])
    assert not free.any() or losses[-1] < losses[0]


def test_all_free_is_as_without_holding_any(device: str, rng: np.random.Generator) -> None:
    gaussians = wall(rng)
    one, _ = fitted(device, gaussians, None, steps=5)
    other, _ = fitted(device, gaussians, np.ones(len(gaussians), bool), steps=5)
    for name, rows in one.arrays().items():
        np.testing.assert_array_equal(getattr(other, name), rows)
