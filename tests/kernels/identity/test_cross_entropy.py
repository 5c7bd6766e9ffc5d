# SPDX-License-Identifier: Apache-2.0
"""Cross-entropy of the rendered identity image against the float64 oracle and finite differences."""

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.kernels.identity import cross_entropy
from ggwarp.kernels.losses.rgbd import LOSS_COUNT, OBJECT
from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.sampling import Sample
from ggwarp.kernels.workspaces import allocate_identity
from ggwarp.ops.reference import identity as oracle

FORMS = ["rows", "pixels"]


@pytest.fixture
def form(request, monkeypatch):
    """Run the CPU's form or, also on the CPU, the one CUDA takes."""
    use(monkeypatch, request.param)
    return request.param


def use(monkeypatch, form):
    monkeypatch.setattr(cross_entropy, "runs_by_rows", lambda device: form == "rows")


def scene(rng, height, width, classes, scale=0.7):
    padded = -(-height // 16) * 16, -(-width // 16) * 16
    image = rng.uniform(-1, 1, (20, *padded)).astype(np.float32)
    labels = rng.integers(-1, classes + 1, (height, width)).astype(np.int32)
    weights = (scale * rng.standard_normal((classes, 16))).astype(np.float32)
    biases = rng.standard_normal(classes).astype(np.float32)
    return image, labels, weights, biases


def run(image, labels, weights, biases, device="cpu", spare=2, sample=(1, 0), **options):
    """Return loss, d_image, d_weights and d_biases for a weight of one."""
    classes, capacity = len(weights), len(weights) + spare
    rubbish = np.full((spare, 16), 1e3, np.float32)
    d_image = wp.full(image.shape, 7.0, dtype=wp.float32, device=device)
    d_weights = wp.full(capacity, vec16(7.0), dtype=vec16, device=device)
    d_biases = wp.full(capacity, 7.0, dtype=wp.float32, device=device)
    losses = wp.zeros(LOSS_COUNT, dtype=wp.float32, device=device)
    cross_entropy.cross_entropy(
        wp.array(image, device=device),
        wp.array(labels, device=device),
        weights=wp.array(np.concatenate([weights, rubbish]), dtype=vec16, device=device),
        biases=wp.array(np.concatenate([biases, rubbish[:, 0]]), device=device),
        classes=classes,
        d_image=d_image,
        d_weights=d_weights,
        d_biases=d_biases,
        losses=losses,
        workspace=allocate_identity(*image.shape[1:], capacity=capacity, device=device),
        sample=Sample(sample[0], wp.full(1, sample[1], dtype=int, device=device)),
        device=device,
        **{"weight": 1.0, **options},
    )
    assert (d_image.numpy()[:4] == 7.0).all()
    assert (d_weights.numpy()[classes:] == 7.0).all() and (d_biases.numpy()[classes:] == 7.0).all()
    gradients = d_image.numpy()[4:], d_weights.numpy()[:classes], d_biases.numpy()[:classes]
    return float(losses.numpy()[OBJECT]), *gradients


def reference(image, labels, weights, biases):
    height, width = labels.shape
    inputs = [
        torch.tensor(v.astype(np.float64), requires_grad=True)
        for v in (image[4:, :height, :width], weights, biases)
    ]
    value = oracle.cross_entropy(inputs[0], torch.tensor(labels), inputs[1], inputs[2])
    value.backward()
    return float(value.detach()), *(v.grad.numpy() for v in inputs)


def assert_gradient(got, want, tolerance=1e-4):
    got, want = got.ravel().astype(np.float64), want.ravel()
    norm = np.linalg.norm(want)
    assert np.linalg.norm(got - want) <= tolerance * norm + 1e-12
    if norm > 0:
        assert got @ want / (norm * np.linalg.norm(got)) >= 0.999
        assert abs((got - want).sum()) <= tolerance * np.abs(want).sum() + 1e-12


def assert_matches(got, want, labels):
    height, width = labels.shape
    assert got[0] == pytest.approx(want[0], rel=1e-5, abs=1e-9)
    assert_gradient(got[1][:, :height, :width], want[1])
    padding = got[1].copy()
    padding[:, :height, :width] = 0.0
    assert not padding.any()
    assert_gradient(got[2], want[2])
    assert_gradient(got[3], want[3])


@pytest.mark.parametrize("form", FORMS, indirect=True)
@pytest.mark.parametrize("classes", [1, 2, 30, 101])
def test_matches_the_oracle(rng, form, classes):
    values = scene(rng, 19, 37, classes)
    assert_matches(run(*values), reference(*values), values[1])


@settings(max_examples=15)
@given(
    height=st.integers(1, 20), width=st.integers(1, 40), classes=st.integers(1, 8), seed=st.integers(0, 99)
)
def test_any_size(height, width, classes, seed):
    values = scene(np.random.default_rng(seed), height, width, classes)
    want = reference(*values)
    with pytest.MonkeyPatch.context() as patch:
        for form in FORMS:
            use(patch, form)
            assert_matches(run(*values), want, values[1])


def test_on_device(rng, device):
    values = scene(rng, 33, 50, 12)
    assert_matches(run(*values, device=device), reference(*values), values[1])


def test_finite_differences(rng):
    image, labels, weights, biases = scene(rng, 6, 9, 5)
    _, d_image, d_weights, d_biases = run(image, labels, weights, biases)
    arrays = [image[4:].astype(np.float64), weights.astype(np.float64), biases.astype(np.float64)]

    def loss(arrays):
        full = np.concatenate([image[:4], arrays[0]])
        return reference(full, labels, arrays[1], arrays[2])[0]

    step = 1e-5
    checks = [
        (0, (3, 2, 4)),
        (0, (0, 0, 0)),
        (0, (15, 5, 8)),
        (1, (0, 3)),
        (1, (4, 15)),
        (2, (1,)),
        (2, (4,)),
    ]
    for which, at in checks:
        high, low = [a.copy() for a in arrays], [a.copy() for a in arrays]
        high[which][at] += step
        low[which][at] -= step
        numeric = (loss(high) - loss(low)) / (2 * step)
        assert (d_image, d_weights, d_biases)[which][at] == pytest.approx(numeric, rel=1e-3, abs=1e-7)


@pytest.mark.parametrize("form", FORMS, indirect=True)
@pytest.mark.parametrize("label", [-1, 7, 1000, -(2**31)])
def test_labels_outside_the_classes_are_ignored(rng, form, label):
    image, labels, weights, biases = scene(rng, 5, 18, 7)
    labels[:] = label
    loss, *gradients = run(image, labels, weights, biases)
    assert loss == 0.0
    assert not any(g.any() for g in gradients)


@pytest.mark.parametrize("form", FORMS, indirect=True)
def test_huge_logits_stay_finite(rng, form):
    values = scene(rng, 8, 20, 6, scale=300.0)
    got, want = run(*values), reference(*values)
    assert all(np.isfinite(g).all() for g in got)
    assert got[0] == pytest.approx(want[0], rel=1e-4)
    assert_gradient(got[2], want[2], 1e-3)


@pytest.mark.parametrize("form", FORMS, indirect=True)
def test_samples_average_to_the_whole(rng, form):
    values = scene(rng, 39, 70, 9)
    whole = run(*values)
    parts = [run(*values, sample=(8, phase)) for phase in range(8)]
    covered = np.zeros(whole[1].shape[1:], int)
    for part in parts:
        left_alone = (part[1] == 7.0).all(axis=0)
        covered += ~left_alone
        part[1][:, left_alone] = 0.0
    assert (covered == 1).all(), "every tile is in one sample"
    for got, want in zip(zip(*parts, strict=True), whole, strict=True):
        np.testing.assert_allclose(np.mean(got, axis=0), want, rtol=2e-4, atol=1e-8)


def test_weight_scales_the_gradient_only(rng):
    values = scene(rng, 5, 6, 3)
    one, half = run(*values), run(*values, weight=0.5)
    assert one[0] == half[0]
    np.testing.assert_allclose(half[1], 0.5 * one[1], rtol=1e-5, atol=1e-9)


def test_says_what_does_not_fit(rng):
    values = scene(rng, 5, 6, 3)
    with pytest.raises(ValueError, match="room for 1 to 0"):
        run(*(v[:0] if i > 1 else v for i, v in enumerate(values)), spare=0)


def test_threads_do_not_change_a_bit(rng, assert_same_on_any_threads):
    values = scene(rng, 70, 40, 11)
    assert_same_on_any_threads(lambda: run(*values))
