# SPDX-License-Identifier: Apache-2.0
"""The most probable class of pixels and Gaussians against NumPy."""

import numpy as np
import pytest
import warp as wp

from ggwarp.kernels.identity import classify
from ggwarp.kernels.identity.classify import classify_gaussians, classify_pixels
from ggwarp.kernels.math import vec16


def softmax_best(e, w, b):
    z = e.astype(np.float64) @ w.T.astype(np.float64) + b
    p = np.exp(z - z.max(-1, keepdims=True))
    return z.argmax(-1), (p / p.sum(-1, keepdims=True)).max(-1)


@pytest.mark.parametrize("by_rows", [True, False])
@pytest.mark.parametrize("classes", [1, 2, 30])
def test_pixels_and_gaussians(rng, device, classes, by_rows, monkeypatch):
    if device == "cpu":  # the form that CUDA takes, too
        monkeypatch.setattr(classify, "runs_by_rows", lambda device: by_rows)
    height, width = 7, 21
    image = rng.standard_normal((20, 16, 32)).astype(np.float32)
    w, b = (
        rng.standard_normal((classes, 16)).astype(np.float32),
        rng.standard_normal(classes).astype(np.float32),
    )
    classifier = {
        "weights": wp.array(w, dtype=vec16, device=device),
        "biases": wp.array(b, device=device),
        "classes": classes,
        "device": device,
    }
    labels = wp.zeros((height, width), dtype=wp.int32, device=device)
    probabilities = wp.zeros((height, width), dtype=wp.float32, device=device)
    classify_pixels(wp.array(image, device=device), labels=labels, probabilities=probabilities, **classifier)
    e = image[4:, :height, :width].transpose(1, 2, 0)
    want_labels, want_probabilities = softmax_best(e, w, b)
    np.testing.assert_array_equal(labels.numpy(), want_labels)
    np.testing.assert_allclose(probabilities.numpy(), want_probabilities, rtol=1e-5)

    flat = np.ascontiguousarray(e.reshape(-1, 16))
    labels = wp.zeros(len(flat), dtype=wp.int32, device=device)
    probabilities = wp.zeros(len(flat), dtype=wp.float32, device=device)
    identities = wp.array(flat, dtype=vec16, device=device)
    classify_gaussians(identities, labels=labels, probabilities=probabilities, **classifier)
    np.testing.assert_array_equal(labels.numpy(), want_labels.ravel())
    np.testing.assert_allclose(probabilities.numpy(), want_probabilities.ravel(), rtol=1e-5)


def test_nan_identity_and_none_at_all(device):
    identities = np.zeros((2, 16), np.float32)
    identities[0] = np.nan
    labels = wp.full(2, 9, dtype=wp.int32, device=device)
    probabilities = wp.full(2, 9.0, dtype=wp.float32, device=device)
    arguments = {
        "weights": wp.zeros(3, dtype=vec16, device=device),
        "biases": wp.array([0.0, 1.0, 1.0], dtype=wp.float32, device=device),
        "classes": 3,
        "device": device,
    }
    classify_gaussians(
        wp.array(identities, dtype=vec16, device=device),
        labels=labels,
        probabilities=probabilities,
        **arguments,
    )
    np.testing.assert_array_equal(labels.numpy(), [-1, 1])
    assert probabilities.numpy()[0] == 0.0
    classify_gaussians(
        wp.zeros(0, dtype=vec16, device=device),
        labels=wp.zeros(0, dtype=wp.int32, device=device),
        probabilities=wp.zeros(0, dtype=wp.float32, device=device),
        **arguments,
    )


def test_nan_pixel(rng):
    image = rng.standard_normal((20, 16, 16)).astype(np.float32)
    image[7, 3, 5] = np.nan
    labels, probabilities = wp.zeros((10, 10), dtype=wp.int32), wp.zeros((10, 10), dtype=wp.float32)
    weights = wp.array(rng.standard_normal((4, 16)).astype(np.float32), dtype=vec16)
    biases = wp.zeros(4, dtype=wp.float32)
    options = {"labels": labels, "probabilities": probabilities, "device": "cpu"}
    classify_pixels(wp.array(image), weights=weights, biases=biases, classes=4, **options)
    bad = np.zeros((10, 10), bool)
    bad[3, 5] = True
    np.testing.assert_array_equal(labels.numpy() < 0, bad)
    np.testing.assert_array_equal(probabilities.numpy() == 0.0, bad)
