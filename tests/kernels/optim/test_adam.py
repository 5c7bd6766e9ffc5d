# SPDX-License-Identifier: Apache-2.0
"""Adam on visible Gaussians and on the classifier, against torch.optim.Adam in float64."""

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim import adam

FIELDS = {
    "means": (3, wp.vec3),
    "quats": (4, wp.vec4),
    "log_scales": (3, wp.vec3),
    "opacity_logits": (0, wp.float32),
    "colours": (3, wp.vec3),
    "identities": (16, vec16),
}
RATES = adam.AdamRates(means=1e-3, quats=2e-3, log_scales=5e-3, opacity=0.05, colours=2.5e-3, identities=3e-3)
RATE_OF = dict(zip(FIELDS, [1e-3, 2e-3, 5e-3, 0.05, 2.5e-3, 3e-3], strict=True))


def random_values(rng, n):
    return {
        name: rng.standard_normal((n, width) if width else n).astype(np.float32)
        for name, (width, _) in FIELDS.items()
    }


def upload(values, device, identities=True):
    names = [name for name in FIELDS if identities or name != "identities"]
    return adam.GaussianArrays(
        **{name: wp.array(values[name], dtype=FIELDS[name][1], device=device) for name in names}
    )


def zero_state(n, device, identities=True):
    moments = [wp.zeros(n, dtype=vec16, device=device) for _ in range(4)]
    steps = wp.zeros(n, dtype=wp.int32, device=device)
    return adam.AdamState(moments[0], moments[1], steps, *(moments[2:] if identities else ()))


def step(parameters, gradients, state, visible, n, device, order=None, decay=0.0):
    order = np.arange(n) if order is None else order
    ranks = np.full(n, -1, np.int32)
    ranks[order[:visible]] = np.arange(visible)
    rates = wp.array(RATES.lanes(), dtype=vec16, device=device)
    adam.adam_gaussians(
        parameters,
        gradients,
        state,
        rates=rates,
        ranks=wp.array(ranks, dtype=int, device=device),
        device=device,
        decay=decay,
    )


def download(parameters):
    return {
        name: getattr(parameters, name).numpy() for name in FIELDS if getattr(parameters, name) is not None
    }


@pytest.mark.parametrize("decay", [0.0, 3.0])
def test_equals_torch_adam(rng, device, decay):
    def slower(t):
        return (1.0 + t / decay) ** -0.5

    n = 40
    start = random_values(rng, n)
    start["quats"] /= np.linalg.norm(start["quats"], axis=1, keepdims=True)
    parameters, state = upload(start, device), zero_state(n, device)
    tensors = {name: torch.tensor(v.astype(np.float64), requires_grad=True) for name, v in start.items()}
    optimiser = torch.optim.Adam(
        [{"params": [tensors[name]], "lr": RATE_OF[name]} for name in FIELDS], eps=1e-15
    )
    slowing = [(lambda t: 1.0) if name == "identities" or not decay else slower for name in FIELDS]
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, slowing)
    for _ in range(5):
        gradients = random_values(rng, n)
        step(parameters, upload(gradients, device), state, n, n, device, decay=decay)
        for name, tensor in tensors.items():
            tensor.grad = torch.tensor(gradients[name].astype(np.float64))
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            tensors["quats"] /= tensors["quats"].norm(dim=1, keepdim=True)
    for name, got in download(parameters).items():
        np.testing.assert_allclose(got, tensors[name].detach().numpy(), atol=3e-6, err_msg=name)
    np.testing.assert_allclose(np.linalg.norm(parameters.quats.numpy(), axis=1), 1.0, atol=1e-6)


@settings(max_examples=15)
@given(n=st.integers(1, 600), share=st.floats(0, 1), seed=st.integers(0, 99))
def test_only_the_visible_move(n, share, seed):
    rng = np.random.default_rng(seed)
    visible, order = int(share * n), rng.permutation(n)
    start = random_values(rng, n)
    parameters, state = upload(start, "cpu"), zero_state(n, "cpu")
    step(parameters, upload(random_values(rng, n), "cpu"), state, visible, n, "cpu", order)
    hidden = np.setdiff1d(np.arange(n), order[:visible])
    for name, got in download(parameters).items():
        np.testing.assert_array_equal(got[hidden], start[name][hidden])
        assert (got[order[:visible]] != start[name][order[:visible]]).all()
    np.testing.assert_array_equal(state.steps.numpy()[order], np.arange(n) < visible)


def test_first_step_of_a_late_gaussian_is_one_rate_long(rng, device):
    start = random_values(rng, 2)
    parameters, state = upload(start, device), zero_state(2, device)
    for _ in range(50):
        step(parameters, upload(random_values(rng, 2), device), state, 1, 2, device)
    step(parameters, upload(random_values(rng, 2), device), state, 2, 2, device)
    moved = np.abs(parameters.opacity_logits.numpy()[1] - start["opacity_logits"][1])
    assert moved == pytest.approx(RATES.opacity, rel=1e-3)


@pytest.mark.parametrize("name", list(FIELDS))
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_a_bad_gradient_skips_that_gaussian(rng, device, name, bad):
    start, gradients = random_values(rng, 3), random_values(rng, 3)
    gradients[name].reshape(3, -1)[1, -1] = bad
    parameters, state = upload(start, device), zero_state(3, device)
    step(parameters, upload(gradients, device), state, 3, 3, device)
    for field, got in download(parameters).items():
        np.testing.assert_array_equal(got[1], start[field][1])
        assert (got[[0, 2]] != start[field][[0, 2]]).all()
    np.testing.assert_array_equal(state.steps.numpy(), [1, 0, 1])
    assert not state.first.numpy()[1].any()


def test_zero_gradient_from_zero_moments_moves_nothing(rng, device):
    start = random_values(rng, 4)
    start["quats"] /= np.linalg.norm(start["quats"], axis=1, keepdims=True)
    parameters = upload(start, device)
    zeros = {name: np.zeros_like(v) for name, v in start.items()}
    step(parameters, upload(zeros, device), zero_state(4, device), 4, 4, device)
    for name, got in download(parameters).items():
        np.testing.assert_allclose(got, start[name], atol=1e-7)


def test_without_identities(rng, device):
    start, gradients = random_values(rng, 5), random_values(rng, 5)
    results = []
    for identities in (True, False):
        parameters, state = upload(start, device, identities), zero_state(5, device, identities)
        step(parameters, upload(gradients, device, identities), state, 5, 5, device)
        results.append(download(parameters))
    for name in results[1]:
        np.testing.assert_array_equal(results[0][name], results[1][name])


def test_empty_map(device):
    parameters = upload(random_values(np.random.default_rng(0), 0), device)
    step(parameters, parameters, zero_state(0, device), 0, 0, device)


def test_threads_do_not_change_a_bit(rng, assert_same_on_any_threads):
    start, gradients = random_values(rng, 1000), random_values(rng, 1000)

    def stepped():
        parameters = upload(start, "cpu")
        step(parameters, upload(gradients, "cpu"), zero_state(1000, "cpu"), 700, 1000, "cpu")
        values = download(parameters)
        return [values[name] for name in FIELDS]

    assert_same_on_any_threads(stepped)


def test_classifier_equals_torch_adam(rng, device):
    capacity, classes = 7, 5
    w, b = (
        rng.standard_normal((capacity, 16)).astype(np.float32),
        rng.standard_normal(capacity).astype(np.float32),
    )
    weights, biases = wp.array(w, dtype=vec16, device=device), wp.array(b, device=device)
    state = {
        "weight_moments": wp.zeros((2, capacity), dtype=vec16, device=device),
        "bias_moments": wp.zeros((2, capacity), dtype=wp.float32, device=device),
        "steps": wp.zeros(capacity, dtype=wp.int32, device=device),
    }
    tw, tb = (torch.tensor(v.astype(np.float64), requires_grad=True) for v in (w, b))
    optimiser = torch.optim.Adam([tw, tb], lr=0.01, eps=1e-15)
    for _ in range(4):
        gw, gb = rng.standard_normal((capacity, 16)), rng.standard_normal(capacity)
        tw.grad, tb.grad = torch.tensor(gw), torch.tensor(gb)
        optimiser.step()
        adam.adam_classifier(
            weights,
            biases,
            d_weights=wp.array(gw.astype(np.float32), dtype=vec16, device=device),
            d_biases=wp.array(gb.astype(np.float32), device=device),
            rate=wp.array([0.01], dtype=wp.float32, device=device),
            classes=classes,
            device=device,
            **state,
        )
    np.testing.assert_allclose(weights.numpy()[:classes], tw.detach().numpy()[:classes], atol=1e-5)
    np.testing.assert_allclose(biases.numpy()[:classes], tb.detach().numpy()[:classes], atol=1e-5)
    np.testing.assert_array_equal(weights.numpy()[classes:], w[classes:])
    np.testing.assert_array_equal(state["steps"].numpy(), [4] * classes + [0] * (capacity - classes))
