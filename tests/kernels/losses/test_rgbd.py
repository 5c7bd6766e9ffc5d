# SPDX-License-Identifier: Apache-2.0
"""Colour and depth losses against the float64 oracle, finite differences and scikit-image."""

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from ggwarp.kernels.losses import rgbd
from ggwarp.kernels.workspaces import allocate_loss
from ggwarp.ops.reference.losses import rgbd_losses, ssim_map

WEIGHTS = {"colour_weight": 0.9, "dssim": 0.2, "depth_weight": 0.1, "d_max": 10.0}


def scene(rng, height, width, channels=4, holes=0.2):
    """A padded render (rubbish in the padding), a target near it, and a depth with holes."""
    hp, wp_ = -(-height // 16) * 16, -(-width // 16) * 16
    image = rng.uniform(-3, 3, (channels, hp, wp_)).astype(np.float32)
    rows, columns = np.mgrid[0:height, 0:width]
    for c in range(3):
        image[c, :height, :width] = 0.5 + 0.4 * np.sin(0.3 * columns + 0.2 * rows + c)
    image[:3, :height, :width] += 0.1 * rng.uniform(-1, 1, (3, height, width))
    colour = image[:3, :height, :width] + 0.1 * rng.uniform(-1, 1, (3, height, width))
    colour = np.clip(colour.transpose(1, 2, 0) * 255, 0, 255).astype(np.uint8)
    depth = rng.uniform(0.5, 5, (height, width)).astype(np.float32)
    if channels > 3:
        image[3, :height, :width] = depth + rng.uniform(-0.5, 0.5, (height, width))
    depth[rng.random((height, width)) < holes] = 0.0
    return image, colour, depth


def run(image, colour, depth, device, *, by_rows=None, weights=None, **options):
    d_image = wp.full(image.shape, 7.0, dtype=wp.float32, device=device)
    losses = wp.zeros(rgbd.LOSS_COUNT, dtype=wp.float32, device=device)
    rgbd.rgbd_loss(
        wp.array(image, device=device),
        wp.array(colour, device=device),
        wp.array(depth, device=device),
        d_image=d_image,
        losses=losses,
        workspace=allocate_loss(*depth.shape, device=device, by_rows=by_rows),
        depth_weights=None if weights is None else wp.array(weights, dtype=wp.uint8, device=device),
        device=device,
        **{**WEIGHTS, **options},
    )
    return losses.numpy(), d_image.numpy()


def oracle(image, colour, depth, mask_colour=True, weights=None):
    height, width = depth.shape
    x = torch.tensor(image[:, :height, :width].astype(np.float64), requires_grad=True)
    target = torch.tensor(colour.astype(np.float64) / 255.0)
    shares = None if weights is None else torch.tensor(weights / 64.0)
    target_depth = torch.tensor(depth.astype(np.float64))
    terms = rgbd_losses(x, target, target_depth, mask_colour=mask_colour, depth_weights=shares)
    rgb = (1 - WEIGHTS["dssim"]) * terms["l1"] + WEIGHTS["dssim"] * terms["dssim"]
    (WEIGHTS["colour_weight"] * rgb + WEIGHTS["depth_weight"] * terms["depth"]).backward()
    values = [float(terms[name].detach()) for name in ("l1", "dssim", "depth", "masked")]
    assert x.grad is not None
    return np.array(values), x.grad.numpy()


def assert_gradient(got, want, tolerance=1e-3):
    got, want = got.ravel().astype(np.float64), want.ravel()
    norm = np.linalg.norm(want)
    assert np.linalg.norm(got - want) <= tolerance * norm + 1e-12
    if norm > 0:
        assert got @ want / (norm * np.linalg.norm(got)) >= 0.999
        assert abs((got - want).sum()) <= tolerance * np.abs(want).sum()


@pytest.mark.parametrize("mask_colour", [True, False])
@pytest.mark.parametrize("channels", [3, 4, 20])
@pytest.mark.parametrize("by_rows", [None, False], ids=["default", "as on CUDA"])
def test_matches_the_oracle(rng, device, by_rows, channels, mask_colour):
    image, colour, depth = scene(rng, 37, 45, channels)
    losses, d_image = run(image, colour, depth, device, mask_colour=mask_colour, by_rows=by_rows)
    want, gradient = oracle(image, colour, depth, mask_colour)
    np.testing.assert_allclose(losses[:4], want, rtol=2e-5, atol=1e-6)
    planes = min(channels, 4)
    for c in range(planes):
        assert_gradient(d_image[c, :37, :45], gradient[c])
    padding = d_image[:planes].copy()
    padding[:, :37, :45] = 0.0
    assert not padding.any()
    assert (d_image[planes:] == 7.0).all()


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("by_rows", [None, False], ids=["default", "as on CUDA"])
def test_readings_that_are_weighed(rng, device, by_rows, channels):
    image, colour, depth = scene(rng, 37, 45, channels)
    weights = rng.integers(0, 256, depth.shape, dtype=np.uint8)
    losses, d_image = run(image, colour, depth, device, by_rows=by_rows, weights=weights)
    want, gradient = oracle(image, colour, depth, weights=weights)
    np.testing.assert_allclose(losses[:4], want, rtol=2e-5, atol=1e-6)
    for c in range(channels):
        assert_gradient(d_image[c, :37, :45], gradient[c])
    for full in (None, np.full_like(weights, 64)):
        same = run(image, colour, depth, device, by_rows=by_rows, weights=full)
        np.testing.assert_allclose(same[0][:4], oracle(image, colour, depth)[0], rtol=2e-5, atol=1e-6)


@settings(max_examples=20)
@given(height=st.integers(1, 40), width=st.integers(1, 40), seed=st.integers(0, 99))
def test_any_size(height, width, seed):
    image, colour, depth = scene(np.random.default_rng(seed), height, width)
    losses, d_image = run(image, colour, depth, "cpu")
    want, gradient = oracle(image, colour, depth)
    np.testing.assert_allclose(losses[:4], want, rtol=1e-4, atol=1e-6)
    assert_gradient(d_image[:4, :height, :width], gradient[:4], 2e-3)


def test_finite_differences(rng, device):
    image, colour, depth = scene(rng, 20, 24, holes=0.1)
    _, d_image = run(image, colour, depth, device)

    def total(x):
        v, _ = oracle(x, colour, depth)
        w = WEIGHTS
        rgb = (1 - w["dssim"]) * v[0] + w["dssim"] * v[1]
        return w["colour_weight"] * rgb + w["depth_weight"] * v[2]

    step = 1e-6
    image = image.astype(np.float64)
    numeric, analytic = [], []
    for c, row, column in [(0, 0, 0), (1, 5, 7), (2, 19, 23), (3, 4, 4), (0, 10, 0), (3, 19, 0)]:
        high, low = image.copy(), image.copy()
        high[c, row, column] += step
        low[c, row, column] -= step
        numeric.append((total(high) - total(low)) / (2 * step))
        analytic.append(d_image[c, row, column])
    np.testing.assert_allclose(analytic, numeric, rtol=2e-3, atol=1e-8)


def test_ssim_agrees_with_scikit_image(rng):
    x, y = rng.random((2, 3, 40, 44))
    ours = ssim_map(torch.tensor(x), torch.tensor(y)).numpy()
    for c in range(3):
        _, theirs = structural_similarity(
            x[c],
            y[c],
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1.0,
            full=True,
        )
        np.testing.assert_allclose(ours[c, 5:-5, 5:-5], theirs[5:-5, 5:-5], atol=1e-10)


def test_equal_images_have_no_loss(rng, device):
    image, colour, depth = scene(rng, 18, 33, holes=0.0)
    image[:3, :18, :33] = colour.transpose(2, 0, 1) / np.float32(255.0)
    image[3, :18, :33] = depth
    losses, d_image = run(image, colour, depth, device)
    np.testing.assert_allclose(losses[:4], [0, 0, 0, 1], atol=1e-6)
    assert np.abs(d_image[:3]).max() <= 1.1 * 0.9 * 0.8 / (3 * 18 * 33)  # L1's kink at rounding errors
    assert not d_image[3].any()


@pytest.mark.parametrize("bad", [0.0, np.nan, -1.0, np.inf])
def test_no_valid_depth_means_no_loss(rng, device, bad):
    image, colour, depth = scene(rng, 9, 17)
    depth[:] = bad
    losses, d_image = run(image, colour, depth, device)
    np.testing.assert_allclose(losses[:4], 0.0, atol=1e-6)
    assert not d_image.any()


def test_nan_depth_is_a_hole(rng, device):
    image, colour, depth = scene(rng, 21, 22)
    spoiled = np.where(depth == 0.0, np.nan, depth).astype(np.float32)
    for got, want in zip(run(image, colour, spoiled, device), run(image, colour, depth, device), strict=True):
        np.testing.assert_array_equal(got, want)


def test_nan_in_a_masked_pixel_stays_out(rng, device):
    image, colour, depth = scene(rng, 21, 22)
    image[:, :21, :22][:, depth == 0.0] = np.nan
    losses, d_image = run(image, colour, depth, device)
    assert np.isfinite(losses).all() and np.isfinite(d_image).all()


def test_threads_do_not_change_a_bit(rng, assert_same_on_any_threads):
    image, colour, depth = scene(rng, 67, 50)
    assert_same_on_any_threads(lambda: run(image, colour, depth, "cpu"))


def test_forms_agree(rng, device):
    """Rows as on the CPU; pixels as on CUDA."""
    image, colour, depth = scene(rng, 40, 50)
    rows = run(image, colour, depth, "cpu")
    planes = run(image, colour, depth, device, by_rows=False)
    np.testing.assert_allclose(planes[0], rows[0], rtol=1e-5)
    assert_gradient(planes[1][:4, :40, :50], rows[1][:4, :40, :50].astype(np.float64), 1e-4)
