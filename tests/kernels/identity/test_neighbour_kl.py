# SPDX-License-Identifier: Apache-2.0
"""KL divergence of neighbouring Gaussians' classes against the float64 oracle."""

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.kernels.identity.neighbour_kl import neighbour_divergence
from ggwarp.kernels.losses.rgbd import LOSS_COUNT, OBJECT_3D
from ggwarp.kernels.math import vec16
from ggwarp.kernels.workspaces import allocate_neighbours
from ggwarp.ops.reference import identity as oracle


def scene(rng, n, samples, k, classes):
    identities = rng.standard_normal((n, 16)).astype(np.float32)
    weights = (0.5 * rng.standard_normal((classes, 16))).astype(np.float32)
    biases = rng.standard_normal(classes).astype(np.float32)
    sampled = rng.integers(0, n, samples).astype(np.int32)
    neighbours = rng.integers(0, n, (samples, k)).astype(np.int32)
    return identities, sampled, neighbours, weights, biases


def run(identities, samples, neighbours, weights, biases, device="cpu", visible=None, start=0.0, weight=1.0):
    n, classes = len(identities), len(weights)
    ranks = np.arange(n) if visible is None else np.where(visible, 1, -1)
    d_identities = wp.full(n, vec16(start), dtype=vec16, device=device)
    d_weights = wp.full(classes, vec16(start), dtype=vec16, device=device)
    d_biases = wp.full(classes, start, dtype=wp.float32, device=device)
    losses = wp.zeros(LOSS_COUNT, dtype=wp.float32, device=device)
    neighbour_divergence(
        wp.array(identities, dtype=vec16, device=device),
        samples=wp.array(samples, device=device),
        neighbours=wp.array(neighbours, device=device),
        ranks=wp.array(ranks.astype(np.int32), device=device),
        weights=wp.array(weights, dtype=vec16, device=device),
        biases=wp.array(biases, device=device),
        classes=classes,
        d_identities=d_identities,
        d_weights=d_weights,
        d_biases=d_biases,
        losses=losses,
        workspace=allocate_neighbours(*neighbours.shape, capacity=classes + 3, device=device),
        weight=weight,
        device=device,
    )
    return float(losses.numpy()[OBJECT_3D]), d_identities.numpy(), d_weights.numpy(), d_biases.numpy()


def reference(identities, samples, neighbours, weights, biases):
    e, w, b = (torch.tensor(v.astype(np.float64), requires_grad=True) for v in (identities, weights, biases))
    value = oracle.neighbour_divergence(e, torch.tensor(samples), torch.tensor(neighbours), w, b)
    value.backward()
    return float(value.detach()), e.grad.numpy(), w.grad.numpy(), b.grad.numpy()


def assert_matches(got, want):
    assert got[0] == pytest.approx(want[0], rel=1e-4, abs=1e-8)
    for g, w in zip(got[1:], want[1:], strict=True):
        assert np.linalg.norm(g - w) <= 1e-4 * np.linalg.norm(w) + 1e-8
        if np.linalg.norm(w) > 1e-6:
            assert (g.ravel() @ w.ravel()) / (np.linalg.norm(g) * np.linalg.norm(w)) >= 0.999
            assert abs((g - w).sum()) <= 1e-4 * np.abs(w).sum()


@pytest.mark.parametrize(("samples", "k", "classes"), [(60, 5, 12), (3, 1, 2), (300, 4, 40)])
def test_matches_the_oracle(rng, device, samples, k, classes):
    values = scene(rng, 80, samples, k, classes)
    assert_matches(run(*values, device=device), reference(*values))


@settings(max_examples=20)
@given(
    n=st.integers(1, 30), samples=st.integers(0, 20), k=st.integers(0, 4), classes=st.integers(1, 6),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_any_size_and_missing_neighbours(n, samples, k, classes, seed):
    rng = np.random.default_rng(seed)
    identities, sampled, neighbours, weights, biases = scene(rng, n, samples, k, classes)
    sampled[rng.random(samples) < 0.2] = -1
    neighbours[rng.random((samples, k)) < 0.2] = rng.choice([-1, n, 2**31 - 1])
    values = identities, sampled, neighbours, weights, biases
    assert_matches(run(*values), reference(*values))


def test_finite_differences(rng):
    values = scene(rng, 9, 8, 3, 4)
    _, *gradients = run(*values)
    arrays = {0: values[0], 3: values[3], 4: values[4]}
    for which, gradient in zip(arrays, gradients, strict=True):
        for _ in range(4):
            at = tuple(rng.integers(0, s) for s in gradient.shape)
            ends = []
            for step in (1e-5, -1e-5):
                moved = [v.astype(np.float64) if i in arrays else v for i, v in enumerate(values)]
                moved[which][at] += step
                ends.append(reference(*moved)[0])
            assert gradient[at] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-3, abs=1e-7)


def test_adds_to_visible_gaussians_only(rng, device):
    values = scene(rng, 40, 50, 5, 7)
    visible = rng.random(40) < 0.5
    whole = run(*values, device=device)
    part = run(*values, device=device, visible=visible, start=2.0, weight=0.5)
    np.testing.assert_array_equal(part[1][~visible], 2.0)
    np.testing.assert_allclose(part[1][visible], 2.0 + 0.5 * whole[1][visible], atol=1e-6)
    np.testing.assert_allclose(part[2], 2.0 + 0.5 * whole[2], atol=1e-6)
    np.testing.assert_allclose(part[3], 2.0 + 0.5 * whole[3], atol=1e-6)
    assert part[0] == whole[0]


def test_equal_identities_have_no_divergence(rng):
    identities, samples, neighbours, weights, biases = scene(rng, 10, 20, 3, 5)
    identities[:] = identities[0]
    loss, *gradients = run(identities, samples, neighbours, weights, biases)
    assert abs(loss) < 1e-7
    assert all(np.abs(g).max() < 1e-7 for g in gradients)


def test_threads_do_not_change_a_bit(rng, assert_same_on_any_threads):
    values = scene(rng, 100, 300, 5, 9)
    assert_same_on_any_threads(lambda: run(*values))
