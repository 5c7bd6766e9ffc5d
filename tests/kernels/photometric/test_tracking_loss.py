# SPDX-License-Identifier: Apache-2.0
"""MonoGS's tracking loss against torch, its gradients against autograd, its Adam against ours."""

import numpy as np
import pytest
import torch
import warp as wp

from ggwarp.kernels.photometric import tracking_loss
from ggwarp.kernels.photometric.tracking_loss import FOLDED, photometric_loss, step_exposure

H, W = 13, 21
WEIGHTS = (0.95, 0.05)
EXPOSURE = (0.15, -0.04)


@pytest.fixture(params=[None, 32], ids=["own form", "CUDA form"], autouse=True)
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The parts that rows are summed in on the device, and as on CUDA."""
    if request.param is not None:
        monkeypatch.setattr(tracking_loss, "pieces_per_row", lambda device: request.param)


def scene(rng: np.random.Generator) -> dict[str, np.ndarray]:
    depth = rng.uniform(0.5, 3.0, (H, W)).astype(np.float32)
    depth[rng.uniform(size=depth.shape) < 0.2] = 0.0
    return {
        "image": rng.uniform(0.0, 1.0, (4, 16, 32)).astype(np.float32)
        * np.float32([[[1]], [[1]], [[1]], [[3]]]),
        "transmittance": rng.choice([0.0, 0.04, 0.3, 1.0], (16, 32)).astype(np.float32),
        "colour": rng.integers(0, 256, (H, W, 3)).astype(np.uint8),
        "mask": (rng.uniform(size=(H, W)) < 0.7).astype(np.uint8),
        "depth": depth,
    }


def ours(s: dict[str, np.ndarray], device: str, *, with_depth: bool) -> tuple[np.ndarray, np.ndarray]:
    d_image = wp.zeros((4, 16, 32), dtype=float, device=device)
    parts = H * tracking_loss.pieces_per_row(device)
    sums = wp.empty((parts, 3), dtype=float, device=device)
    photometric_loss(
        wp.array(s["image"], device=device),
        wp.array(s["transmittance"], device=device),
        colour=wp.array(s["colour"], dtype=wp.uint8, device=device),
        mask=wp.array(s["mask"], dtype=wp.uint8, device=device),
        depth=wp.array(s["depth"], device=device) if with_depth else None,
        exposure=wp.array(EXPOSURE, dtype=float, device=device),
        weights=WEIGHTS,
        d_image=d_image,
        sums=sums,
        device=device,
    )
    return d_image.numpy(), sums.numpy().sum(0)


def reference(s: dict[str, np.ndarray], *, with_depth: bool) -> tuple[float, np.ndarray, float, float]:
    image = torch.tensor(s["image"][:, :H, :W].astype(np.float64), requires_grad=True)
    a, b = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in EXPOSURE)
    opacity = torch.tensor(1.0 - s["transmittance"][:H, :W].astype(np.float64))
    target = torch.tensor(s["colour"].transpose(2, 0, 1) / 255.0)
    weight = opacity * torch.tensor(s["mask"].astype(np.float64))
    loss = WEIGHTS[0] * (weight * (torch.exp(a) * image[:3] + b - target).abs()).mean()
    if with_depth:
        depth = torch.tensor(s["depth"].astype(np.float64))
        loss = loss + WEIGHTS[1] * (((image[3] - depth).abs()) * (depth > 0.01) * (opacity > 0.95)).mean()
    loss.backward()
    assert image.grad is not None and a.grad is not None and b.grad is not None
    return float(loss.detach()), image.grad.numpy(), float(a.grad), float(b.grad)


@pytest.mark.parametrize("with_depth", [True, False])
def test_loss_and_gradients(device: str, rng: np.random.Generator, with_depth: bool) -> None:
    s = scene(rng)
    d_image, sums = ours(s, device, with_depth=with_depth)
    loss, d_reference, d_a, d_b = reference(s, with_depth=with_depth)
    np.testing.assert_allclose(sums, [loss, d_a, d_b], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(d_image[:, :H, :W], d_reference, rtol=1e-4, atol=1e-9)
    assert not d_image[:, H:].any() and not d_image[:, :, W:].any()


def test_a_view_past_the_map_has_no_gradient(device: str, rng: np.random.Generator) -> None:
    s = scene(rng)
    s["transmittance"][:] = 1.0
    d_image, sums = ours(s, device, with_depth=True)
    assert not d_image.any() and not sums.any()


def test_exposure_steps_are_adam_s(device: str, rng: np.random.Generator) -> None:
    moments = wp.zeros((2, 2), dtype=float, device=device)
    steps = wp.zeros(1, dtype=wp.int32, device=device)
    exposure = wp.array(EXPOSURE, dtype=float, device=device)
    loss = wp.zeros(1, dtype=float, device=device)
    expected = torch.tensor(EXPOSURE, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([expected], lr=1e-2, eps=1e-15)
    for _ in range(15):
        rows = rng.normal(size=(12 * H, 3)).astype(np.float32)
        expected.grad = torch.tensor(rows[:, 1:].sum(0, dtype=np.float64))
        adam.step()
        sums = wp.array(rows, device=device)
        step_exposure(
            sums,
            folded=wp.empty((FOLDED, 3), dtype=float, device=device),
            rate=1e-2,
            moments=moments,
            steps=steps,
            exposure=exposure,
            loss=loss,
            device=device,
        )
        np.testing.assert_allclose(loss.numpy()[0], rows[:, 0].sum(dtype=np.float64), rtol=1e-5)
    np.testing.assert_allclose(exposure.numpy(), expected.detach().numpy(), rtol=1e-4)
