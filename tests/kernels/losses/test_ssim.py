# SPDX-License-Identifier: Apache-2.0
"""Similarity: the form for CUDA beside that for a CPU, which its tests compare with the oracle."""

import numpy as np
import pytest
import warp as wp

from ggwarp.kernels.losses import ssim, ssim_planes
from ggwarp.kernels.workspaces import allocate_loss, allocate_ssim


def evaluate(form, workspace, x, y, device):
    losses, d_image = wp.zeros(4, dtype=float, device=device), wp.zeros_like(x)
    size = {"height": x.shape[1], "width": x.shape[2]}
    form.ssim_forward(x, y, losses=losses, workspace=workspace, device=device)
    form.compare_adjoint(
        **size, l1_weight=0.7, ssim_weight=-0.3, d_image=d_image, workspace=workspace, device=device
    )
    return losses.numpy()[:2], d_image.numpy()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 3), (40, 50), (17, 211)])
def test_planes_agree_with_pixels(rng, height, width):
    x, y = (wp.array(rng.random((3, height, width)), dtype=float, device="cpu") for _ in range(2))
    pixels = evaluate(ssim, allocate_ssim(height, width, device="cpu"), x, y, "cpu")
    workspace = allocate_loss(height, width, device="cpu", by_rows=False)
    planes = evaluate(ssim_planes, workspace, x, y, "cpu")
    np.testing.assert_allclose(planes[0], pixels[0], rtol=1e-5)
    np.testing.assert_allclose(planes[1], pixels[1], rtol=1e-4, atol=1e-6 * np.abs(pixels[1]).max())


@pytest.mark.parametrize("in_blocks", [False, True])
def test_sums_are_folded_in_two_steps(rng, monkeypatch, in_blocks):
    """More pixels than the first step has sums: each is counted once, by one thread or a block of them."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", in_blocks)
    height, width = 96, 100
    x = wp.array(rng.random((3, height, width)), dtype=float, device="cpu")
    y = wp.zeros_like(x)
    workspace = allocate_loss(height, width, device="cpu", by_rows=False)
    assert height * width > ssim_planes.BINS
    losses, _ = evaluate(ssim_planes, workspace, x, y, "cpu")
    assert losses[0] == pytest.approx(x.numpy().mean(), rel=1e-6)
